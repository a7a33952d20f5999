"""Where the header of a CSV table is, what parts its cells, and where its rows begin.

A header may stand behind ``#``, below ``sep=;`` or below lines of title, and a HAPI server writes it as JSON behind
``#``. A table without any header is refused in these words.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry.faults import quoted
from magcal_core.telemetry.iso_times import is_number, iso_match
from magcal_core.telemetry.table import EMPTY_CELLS

SEPARATORS: Final = ",;\t"
MOST_LINES_ABOVE: Final = 200
"""Lines among which the header is looked for."""
_DECLARED: Final = re.compile(r'"?sep=(.)"?', re.IGNORECASE)
_DATA: Final = re.compile(r"[+-]?\.?\d")
_DECIMAL_COMMA: Final = re.compile(rb"(?:^|[;\t\"])\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*(?=[;\t\"\r\n])", re.MULTILINE)
_DECIMAL_POINT: Final = re.compile(rb"(?:^|[;\t\"])\s*[+-]?\d+\.\d+(?:[eE][+-]?\d+)?\s*(?=[;\t\"\r\n])", re.MULTILINE)
_BLANKS: Final = re.compile(rb" +")
_BLANKS_OUTSIDE: Final = re.compile(rb"^ +| +(?=\r?$)", re.MULTILINE)
_PROBED_BYTES: Final = 1 << 16
_UNITS: Final = frozenset({"nt", "ut", "mt", "t", "g", "mg", "counts", "gauss", "tesla", "nanotesla", "microtesla"})


@dataclass(frozen=True, slots=True)
class Layout:
    """How a CSV table is laid out.

    Attributes
    ----------
    header : names of the columns, as they stand there.
    header_line : the line they stand in, "" where JSON behind ``#`` has them.
    separator : what parts the cells.
    start : offset of the first row, bytes.
    first_line : its number.
    decimal : ``.`` or ``,``.
    time : the column of the times, where the header says which it is.
    fills : column -> the number that stands for an empty cell there, where the header says so.
    """

    header: Sequence[str]
    header_line: str
    separator: str
    start: int
    first_line: int
    decimal: str = "."
    time: str | None = None
    fills: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Line:
    text: str
    number: int
    end: int


def find_layout(text: bytes) -> Layout:
    """Return how the table in ``text`` is laid out.

    Raises
    ------
    TelemetryFormatError
        The table is empty, or has no header at all.
    """
    few = _first_lines(text, 3)
    if few and not few[0].text.startswith("#") and _DECLARED.fullmatch(few[0].text.strip()) is None:
        # Nearly all tables begin with their header and a row of as many cells: no more of them is looked at.
        separator = _separator(few[0].text, [line.text for line in few[1:2]])
        if _header_among(few[:2], separator) == 0:
            return _at_header(few, 0, separator, text)
    lines = _first_lines(text, MOST_LINES_ABOVE)
    comments = [line for line in lines if line.text.startswith("#")]
    plain = [line for line in lines if not line.text.startswith("#")]
    declared = None
    if plain and (match := _DECLARED.fullmatch(plain[0].text.strip())):
        declared = match[1]
        plain = plain[1:]
    if not plain:
        raise TelemetryFormatError("the CSV table is empty: no header row")
    above = [line for line in comments if line.number < plain[0].number]
    if (hapi := _hapi(above)) is not None:
        names, time, fills = hapi
        return Layout(names, "", ",", above[-1].end, above[-1].number + 1, ".", time, fills)
    separator = declared or _separator(plain[0].text, [line.text for line in plain[1:2]])
    if _is_data(split_line(plain[0].text, separator)):
        return _below_comment(above, plain[0], separator, text)
    at = _header_among(plain, declared) or 0
    separator = declared or _separator(plain[at].text, [one.text for one in plain[at + 1 : at + 2]])
    return _at_header(plain, at, separator, text)


def with_tabs(text: bytes) -> bytes:
    """Return a table whose cells are parted by blanks alone with a tab between them; any other as it is.

    It is such a table where two lines, one below the other, part into as many cells, four at least, the second is a row
    of numbers, and neither has another separator. Lines stay lines.
    """
    few = [line.text for line in _first_lines(text, 3) if not line.text.startswith("#")]
    if any(separator in line for line in few[-1:] for separator in SEPARATORS):
        return text
    plain = [line.text for line in _first_lines(text, MOST_LINES_ABOVE) if not line.text.startswith("#")]
    for above, below in pairwise(plain):
        if any(separator in line for line in (above, below) for separator in SEPARATORS):
            continue
        if 4 <= len(below.split()) == len(above.split()) and _is_data(below.split()):
            return _BLANKS.sub(b"\t", _BLANKS_OUTSIDE.sub(b"", text))
    return text


def _at_header(plain: Sequence[_Line], at: int, separator: str, text: bytes) -> Layout:
    line = plain[at]
    header = split_line(line.text, separator)
    if at + 1 < len(plain) and _is_units(split_line(plain[at + 1].text, separator), len(header)):
        at += 1
    return Layout(header, line.text, separator, plain[at].end, plain[at].number + 1, _decimal(text, separator))


def _first_lines(text: bytes, most: int) -> list[_Line]:
    """Return the first lines that are not blank, as far as a header may be among them."""
    lines: list[_Line] = []
    at = number = plain = 0
    while at < len(text) and plain < most:
        newline = text.find(b"\n", at)
        end = text.find(b"\r", at, None if newline < 0 else newline)
        end = end if end >= 0 else newline if newline >= 0 else len(text)
        line = text[at:end].decode("utf-8").strip("\ufeff")
        at = min(end + (2 if text[end : end + 2] == b"\r\n" else 1), len(text))
        number += 1
        if line.strip():
            lines.append(_Line(line, number, at))
            plain += not line.startswith("#")
    return lines


def split_line(line: str, separator: str) -> list[str]:
    """Return the cells of one line.

    Raises
    ------
    TelemetryFormatError
        Its quotes are broken.
    """
    try:
        return next(csv.reader([line], delimiter=separator, strict=True, skipinitialspace=separator != "\t"), [])
    except csv.Error as error:
        raise TelemetryFormatError(f"line {quoted(line)}: {error}") from error


def _cells(line: str, separator: str) -> list[str]:
    """Return the cells of a line that may be anything."""
    try:
        return split_line(line, separator)
    except TelemetryFormatError:
        return [line]


def _separator(line: str, following: Sequence[str]) -> str:
    """Return what parts the cells of a line: what it has most of; of two, what parts the line after it as often."""
    counts = {separator: line.count(separator) for separator in SEPARATORS}
    most = max(counts.values())
    best = [separator for separator, count in counts.items() if count == most]
    agreeing = [one for one in best if following and following[0].count(one) == most]
    return (agreeing or best)[0]


def _is_data(cells: Sequence[str]) -> bool:
    """Return whether cells are those of a row rather than names: all but a few are numbers or times."""
    given = [cell.strip() for cell in cells if cell.strip() not in EMPTY_CELLS]
    values = [cell for cell in given if _DATA.match(cell) and (is_number(cell.replace(",", ".")) or _is_time(cell))]
    return len(values) >= 3 and len(values) >= 0.6 * len(given)


def _is_time(cell: str) -> bool:
    return iso_match(cell) is not None or re.fullmatch(r"[\d./:\-T ,]+Z?", cell) is not None


def _below_comment(above: Sequence[_Line], first: _Line, separator: str, text: bytes) -> Layout:
    """Return the layout of a table whose header stands behind ``#``, above its first row."""
    width = len(split_line(first.text, separator))
    for line in reversed(above):
        names_line = line.text.lstrip("# \t")
        for one in (separator, *SEPARATORS):
            names = _cells(names_line, one)
            if len(names) == width and not _is_data(names):
                # The first row was found as a line: rows begin where the last comment above it ends.
                end = above[-1]
                return Layout(names, names_line, separator, end.end, end.number + 1, _decimal(text, separator))
    raise _no_header(first)


def _no_header(first: _Line) -> TelemetryFormatError:
    return TelemetryFormatError(
        f"the CSV table has no header at all: line {first.number} is data already ({quoted(first.text)}); put the "
        "names of the columns in a line above it, such as time,bx,by,bz"
    )


def _header_among(plain: Sequence[_Line], declared: str | None) -> int | None:
    """Return which line is the header: the first that parts into as many cells as the row below it; titles do not.

    None where no line does.
    """
    for at, line in enumerate(plain[:-1]):
        separator = declared or _separator(line.text, [plain[at + 1].text])
        cells, below = _cells(line.text, separator), _cells(plain[at + 1].text, separator)
        if len(cells) >= 3 and len(cells) == len(below) and not _is_data(cells):
            return at
        if at and _is_data(cells):
            if len(_cells(plain[0].text, declared or _separator(plain[0].text, []))) < 3:
                raise _no_header(line)
            break
    return None


def _is_units(cells: Sequence[str], width: int) -> bool:
    """Return whether a row below the header has the units of its columns."""
    plain = [re.sub(r"[\[\]()]", "", cell).strip().lower() for cell in cells]
    return len(cells) == width and sum(cell in _UNITS for cell in plain) >= 3


def _decimal(text: bytes, separator: str) -> str:
    """Return ``,`` where numbers are written with a decimal comma, in what can be seen of them."""
    if separator == ",":
        return "."
    head = text[:_PROBED_BYTES]
    return "," if _DECIMAL_COMMA.search(head) and not _DECIMAL_POINT.search(head) else "."


def _hapi(comments: Sequence[_Line]) -> tuple[list[str], str | None, dict[str, float]] | None:
    """Return columns, time and fill values of a HAPI header (JSON behind ``#``), None where there is none."""
    text = "\n".join(line.text.lstrip("#") for line in comments).strip()
    if not text.startswith("{") or '"parameters"' not in text:
        return None
    try:
        parameters = json.loads(text)["parameters"]
        named = [(str(one["name"]), one) for one in parameters]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise TelemetryFormatError("the HAPI header behind # is not the JSON of its parameters") from error
    names: list[str] = []
    fills: dict[str, float] = {}
    time = None
    for name, one in named:
        size = one.get("size", [1]) if isinstance(one, dict) else [1]
        count = 1
        for length in size if isinstance(size, list) else [1]:
            count *= int(length)
        if not 1 <= count <= 512:
            raise TelemetryFormatError(f"the HAPI parameter {quoted(name)} has {count} components")
        own = [name] if count == 1 else [f"{name}_{i}" for i in range(count)]
        names += own
        time = name if time is None and one.get("type") == "isotime" else time
        if not isinstance(fill := one.get("fill"), bool) and is_number(str(fill)):
            fills |= dict.fromkeys(own, float(fill))
    return names, time, fills
