"""The formats of exports for flight software: a format is one writer and one line in `EXPORTERS`."""

from __future__ import annotations

import csv
import io
import json
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import yaml

from app.parameter_sets.flight_tables import ON_BOARD, Document, flight_numbers, fprime_parameters, gomspace_table
from app.parameter_sets.fprime_file import FPRIME_FILE, parameter_file


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """How a parameter set is written: content type, writer, and the one convention that the format has, if so.

    ``is_single``: its numbers are single-precision floats, and what is read back is compared as such.
    """

    media_type: str
    write: Callable[[Document], str | bytes]
    convention: str | None = None
    is_single: bool = False


def _json(document: Document) -> str:
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def _yaml(document: Document) -> str:
    text: str = yaml.safe_dump(dict(document), sort_keys=False, allow_unicode=True)
    return text


def _csv(document: Document) -> str:
    """Return one line a number: name, value."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["name", "value"])
    writer.writerows(_leaves("", document))
    return out.getvalue()


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), one)
    elif isinstance(value, list):
        for number, one in enumerate(value):
            yield from _leaves(f"{name}[{number}]", one)
    elif isinstance(value, float):
        yield name, repr(value)
    else:
        yield name, "" if value is None else value


def _c_header(document: Document) -> str:
    guard = f"MAGCAL_{_macro(document['satellite'])}_{_macro(document['magnetometer'])}_H"
    told = {name: value for name, value in document.items() if isinstance(value, str)}
    about = [f" * {name}: {value.replace('*/', '* /').replace('/*', '/ *')}" for name, value in told.items()]
    parameters = document["parameters"]
    arrays = dict(parameters) if isinstance(parameters, Mapping) else {}
    arrays["correction_matrix"] = document["correction_matrix"]
    arrays["worked"] = document["worked_example"]
    lines = [
        "/* magcal parameter set.",
        *(
            line
            for text in about
            for line in textwrap.wrap(text, 110, subsequent_indent=" *   ", break_long_words=False)
        ),
        " * MAGCAL_WORKED_RAW_NT put through the formula gives MAGCAL_WORKED_CORRECTED_NT.",
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        *(line for name, value in arrays.items() for line in _c_constants(f"MAGCAL_{_macro(name)}", value)),
        "",
        f"#endif /* {guard} */",
    ]
    return "\n".join(lines) + "\n"


def _c_constants(name: str, value: object) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _c_constants(f"{name}_{_macro(key)}", one)
    elif isinstance(value, list):
        sizes = f"[{len(value)}]" + (f"[{len(value[0])}]" if value and isinstance(value[0], list) else "")
        yield f"static const double {name}{sizes} = {_c_list(value)};"
    elif isinstance(value, float | int):
        yield f"static const double {name} = {value!r};"


def _c_list(value: object) -> str:
    return "{" + ", ".join(map(_c_list, value)) + "}" if isinstance(value, list) else repr(value)


def _macro(name: object) -> str:
    return re.sub(r"[^A-Z0-9]", "_", str(name).upper())


def _fprime_file(document: Document) -> bytes:
    return parameter_file(flight_numbers(document), 0, has_crc=True)


EXPORTERS: Final[Mapping[str, ExportFormat]] = {
    "json": ExportFormat("application/json", _json),
    "csv": ExportFormat("text/csv; charset=utf-8", _csv),
    "yaml": ExportFormat("application/yaml", _yaml),
    "c": ExportFormat("text/x-c; charset=utf-8", _c_header),
    "gomspace": ExportFormat("text/plain; charset=utf-8", gomspace_table, ON_BOARD, is_single=True),
    "fprime": ExportFormat("application/json", fprime_parameters, ON_BOARD, is_single=True),
    FPRIME_FILE: ExportFormat("application/octet-stream", _fprime_file, ON_BOARD, is_single=True),
}
"""Name -> format."""
