"""What was read back from a flight computer, in the form of an export: the numbers, as they are written there."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal, InvalidOperation
from typing import Final

import yaml

from app.parameter_sets.fprime_file import FPRIME_FILE, records_of
from magcal_core.errors import InputError

MOST_NUMBERS: Final = 2000
NUMBER: Final = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
C_CONSTANT: Final = re.compile(r"\b(MAGCAL_\w+)\s*(?:\[\d+\]\s*)*=\s*([^;]*);")
C_CONVENTION: Final = re.compile(r"^ \* convention: (\S+)", re.MULTILINE)
GOMSPACE_SET: Final = re.compile(r"^\s*(?:set\s+)?(mgm_\w+)\[(\d+)\]\s*[:=]?\s+(\S+)\s*$")
GOMSPACE_LIST: Final = re.compile(
    r"^\s*(?:0x[0-9a-fA-F]+\s+)?(mgm_\w+)\s+(?:FLT|DBL|float|double)\b\s*(?:\[\d+\])?\s*[:=]?\s+(.*)$"
)


FPRIME_ORDER: Final = ("mgm_offset", "mgm_scale", "mgm_rotation")
"""What the first ids are of, in the order of the export; those of the regressors follow."""
MOST_REGRESSORS: Final = 64


class ReadBackError(InputError):
    """What was read back is not in the form that it is said to be in, or has no numbers of a parameter set."""

    code = "read_back"


def read_back(form: str, content: str, first_id: int = 0) -> tuple[str | None, dict[str, Decimal]]:
    """Return the convention that ``content`` names, if it does, and its numbers: name -> value as written.

    A parameter file of F Prime is in base64, and has the numbers under ids from ``first_id`` on.

    Raises
    ------
    ReadBackError
        It cannot be read as ``form``, or has no number, one that is not finite, or more than a parameter set has.
    """
    try:
        convention, pairs = _fprime_file(content, first_id) if form == FPRIME_FILE else READERS[form](content)
        numbers: dict[str, Decimal] = {}
        for name, text in pairs:
            if len(numbers) >= MOST_NUMBERS:
                raise ReadBackError(f"there are more than {MOST_NUMBERS} values, which is the limit")
            value = _decimal(text)
            if value is not None:
                numbers[name] = value
    except (ValueError, RecursionError, yaml.YAMLError, csv.Error) as error:
        raise ReadBackError(f"it cannot be read as {form}: {type(error).__name__}") from None
    if not numbers:
        raise ReadBackError(f"there is no number of a parameter set in it, read as {form}")
    return convention, numbers


def _decimal(text: object) -> Decimal | None:
    """Return the number that ``text`` is, None where it is none."""
    if isinstance(text, bool) or text is None:
        return None
    try:
        value = Decimal(str(text).strip().rstrip("fF"))
    except InvalidOperation:
        return None
    if not math.isfinite(float(value)):
        raise ReadBackError("a value is not a finite number")
    return value


Pairs = Iterator[tuple[str, object]]


def _leaves(document: object) -> Pairs:
    """Yield the values of a document with their paths, depth first."""
    stack: list[tuple[str, object]] = [("", document)]
    while stack:
        name, value = stack.pop()
        if isinstance(value, Mapping):
            stack += [(f"{name}.{key}" if name else str(key), one) for key, one in reversed(list(value.items()))]
        elif isinstance(value, list):
            stack += [(f"{name}[{number}]", one) for number, one in reversed(list(enumerate(value)))]
        else:
            yield name, value
        if len(stack) > MOST_NUMBERS:
            raise ReadBackError(f"there are more than {MOST_NUMBERS} values, which is the limit")


def _convention(document: object) -> str | None:
    found = document.get("convention") if isinstance(document, Mapping) else None
    return found if isinstance(found, str) else None


def _json(content: str) -> tuple[str | None, Pairs]:
    document = json.loads(content, parse_float=Decimal, parse_int=Decimal)
    return _convention(document), _leaves(document)


def _yaml(content: str) -> tuple[str | None, Pairs]:
    document = yaml.load(content, Loader=yaml.BaseLoader)  # noqa: S506  BaseLoader makes nothing but text
    return _convention(document), _leaves(document)


def _csv(content: str) -> tuple[str | None, Pairs]:
    rows = [row for row in csv.reader(io.StringIO(content)) if len(row) == 2]
    named = dict(rows)
    return named.get("convention"), iter(named.items())


def _c(content: str) -> tuple[str | None, Pairs]:
    found = C_CONVENTION.search(content)
    return None if found is None else found[1], _c_numbers(content)


def _c_numbers(content: str) -> Pairs:
    """Yield the constants under the macros' own names, each list number by number: ``MAGCAL_SCALE[1]``."""
    for name, value in C_CONSTANT.findall(content):
        numbers = NUMBER.findall(value)
        for number, text in enumerate(numbers):
            yield (f"{name}[{number}]" if "{" in value else name), text


def _gomspace(content: str) -> tuple[str | None, Pairs]:
    return "on-board", _gomspace_numbers(content)


def _gomspace_numbers(content: str) -> Pairs:
    """Yield the numbers of ``set`` commands, or of a listing of the parameter system."""
    for line in content.splitlines():
        if line.lstrip().startswith("#"):
            continue
        one, several = GOMSPACE_SET.match(line), GOMSPACE_LIST.match(line)
        if one is not None:
            yield f"{one[1]}[{int(one[2])}]", one[3]
        elif several is not None:
            for number, text in enumerate(NUMBER.findall(several[2])):
                yield f"{several[1]}[{number}]", text


def _fprime(content: str) -> tuple[str | None, Pairs]:
    """Read parameters of F Prime: of one component, or of several, of which one has a magnetometer's."""
    document = json.loads(content, parse_float=Decimal, parse_int=Decimal)
    pairs = ((name.rpartition(".")[2].lower(), value) for name, value in _leaves(document))
    return "on-board", (pair for pair in pairs if pair[0].startswith("mgm_"))


def _fprime_file(content: str, first_id: int = 0) -> tuple[str | None, Pairs]:
    return "on-board", _fprime_numbers(base64.b64decode(content, validate=True), first_id)


def _fprime_numbers(content: bytes, first_id: int) -> Pairs:
    """Yield the numbers of a parameter file, F32 or F64; a regressor, whose name no file has, by its number."""
    for number, value in records_of(content):
        place = number - first_id
        name = FPRIME_ORDER[place] if 0 <= place < len(FPRIME_ORDER) else f"mgm_reg_{place - len(FPRIME_ORDER)}"
        count = 9 if name == "mgm_rotation" else 3
        kind = {4 * count: "f", 8 * count: "d"}.get(len(value))
        if place < 0 or place >= len(FPRIME_ORDER) + MOST_REGRESSORS or kind is None:
            continue
        for i, one in enumerate(struct.unpack(f">{count}{kind}", value)):
            if not math.isfinite(one):
                raise ReadBackError("a value is not a finite number")
            yield f"{name}[{i}]", repr(one)


READERS: Final[Mapping[str, Callable[[str], tuple[str | None, Pairs]]]] = {
    "json": _json,
    "csv": _csv,
    "yaml": _yaml,
    "c": _c,
    "gomspace": _gomspace,
    "fprime": _fprime,
    FPRIME_FILE: _fprime_file,
}
"""Format of an export -> its reader."""
