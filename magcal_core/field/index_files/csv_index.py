"""An index as a table of one's own: CSV with the start or the middle of each hour, and its values."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv

from magcal_core.errors import Fault, IndexFormatError, InputError, TimeZoneMissingError
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.index_files.rows import LARGEST_KP, LARGEST_NT, Rows, number_of
from magcal_core.telemetry.iso_times import parse_iso_ns

TIME_COLUMNS: Final = ("hour", "time")
"""Start and middle of the interval."""
VALUE_COLUMNS: Final[Mapping[tuple[str, ...], str]] = {
    ("rc_external_nt", "rc_induced_nt"): "RC",
    ("rc_nt",): "RC",
    ("dst_nt",): "Dst",
    ("kp",): "Kp",
}
"""Columns of values -> the index that they are."""
_KP_STEP_NS: Final = 3 * HOUR_NS


@dataclass(frozen=True, slots=True)
class _Header:
    """Which cell of a row is what."""

    time: int
    is_middle: bool
    values: tuple[int, ...]
    name: str
    width: int


def is_header(line: str) -> bool:
    """Return whether ``line`` heads such a table: a known column of time or of values stands in it."""
    names = {cell.strip().lower() for cell in line.split(",")}
    known = {name for columns in VALUE_COLUMNS for name in columns} | set(TIME_COLUMNS)
    return bool(names & known)


def read(text: str, sha256: str) -> Index:
    """Return the index of a table; an empty cell is an interval without a value.

    Raises
    ------
    IndexFormatError
        A column is unknown, missing or there twice, a cell is no number, or an interval is not whole.
    TimeZoneMissingError
        A time has no zone.
    """
    if (quick := _quick(text, sha256)) is not None:
        return quick
    numbered = enumerate(csv.reader(text.splitlines()), 1)
    table = [(line, cells) for line, cells in numbered if any(map(str.strip, cells)) and not cells[0].startswith("#")]
    if not table:
        raise IndexFormatError("no record of an index in the csv file")
    header = _header(*table[0])
    faults = Rows(HOUR_NS)
    good = [(line, cells) for line, cells in table[1:] if _is_whole(faults, line, cells, header)]
    times_ns = [_time_ns(faults, line, cells[header.time].strip()) for line, cells in good]
    rows = _rows_of(faults, good, times_ns, header)
    return _index(rows, header, sha256)


def _index(rows: Rows, header: _Header, sha256: str) -> Index:
    return rows.index(header.name, "csv", sha256, largest=LARGEST_KP if header.name == "Kp" else LARGEST_NT)


def _quick(text: str, sha256: str) -> Index | None:
    """Return the index of a table without faults, read by columns; None where a row may be at fault.

    Thirty years of hours row by row take five times as long.
    """
    first = text.partition("\n")[0].rstrip("\r")
    if "#" in text or '"' in text or not is_header(first):
        return None
    header, names = _header(1, first.split(",")), [str(column) for column in range(first.count(",") + 1)]
    types = {name: pa.timestamp("ns", "UTC") if int(name) == header.time else pa.float64() for name in names}
    try:
        table = pa_csv.read_csv(
            pa.BufferReader(text.encode()),
            read_options=pa_csv.ReadOptions(column_names=names, skip_rows=1, use_threads=False),
            convert_options=pa_csv.ConvertOptions(column_types=types, null_values=[""], strings_can_be_null=False),
        )
    except pa.ArrowInvalid:
        return None
    time = table.column(header.time)
    if time.null_count or not len(time):
        return None
    stamps = time.combine_chunks().cast(pa.int64()).to_numpy()
    columns = [table.column(column).combine_chunks() for column in header.values]
    values = [np.asarray(column.to_numpy(zero_copy_only=False), np.float64) for column in columns]
    is_whole = all(np.isfinite(a[~np.asarray(c.is_null())]).all() for a, c in zip(values, columns, strict=True))
    step_ns = _step_ns(stamps.tolist(), header)
    back_ns = step_ns // 2 if header.is_middle else 0
    if not is_whole or np.any((stamps - back_ns) % step_ns):
        return None
    rows = Rows(step_ns)
    rows.add_all(
        range(2, 2 + len(stamps)), stamps - back_ns, values if len(values) == 1 else [values[0] + values[1], *values]
    )
    return _index(rows, header, sha256)


def _header(line: int, cells: Sequence[str]) -> _Header:
    names = [cell.strip().lower() for cell in cells]
    known = {name for columns in VALUE_COLUMNS for name in columns} | set(TIME_COLUMNS)
    unknown = [name for name in names if name not in known]
    times = [name for name in TIME_COLUMNS if name in names]
    values = tuple(name for name in names if name in known and name not in TIME_COLUMNS)
    found = next((columns for columns in VALUE_COLUMNS if sorted(columns) == sorted(values)), None)
    why = ""
    if unknown:
        why = f"unknown column {unknown[0]!r}"
    elif len(set(names)) < len(names):
        why = "a column is there twice"
    elif len(times) != 1:
        why = "want one of hour (start) and time (middle), not both"
    elif found is None:
        why = "want rc_external_nt with rc_induced_nt, or rc_nt, or dst_nt, or kp"
    if why or found is None:
        raise IndexFormatError(
            f"1 fault in the index file (csv); first: line {line}: {why}", [Fault(f"line {line}", why)]
        )
    columns = tuple(names.index(name) for name in found)
    return _Header(names.index(times[0]), times[0] == "time", columns, VALUE_COLUMNS[found], len(names))


def _is_whole(rows: Rows, line: int, cells: Sequence[str], header: _Header) -> bool:
    if len(cells) == header.width:
        return True
    rows.refuse(line, f"{len(cells)} cells; the header has {header.width}")
    return False


def _time_ns(rows: Rows, line: int, text: str) -> int | None:
    try:
        return parse_iso_ns(text)
    except InputError as error:
        rows.has_no_zone = rows.has_no_zone or isinstance(error, TimeZoneMissingError)
        rows.refuse(line, error.message, text)
        return None


def _rows_of(
    faults: Rows, good: Sequence[tuple[int, Sequence[str]]], times_ns: Sequence[int | None], header: _Header
) -> Rows:
    step_ns = _step_ns([time for time in times_ns if time is not None], header)
    rows = Rows(step_ns, faults=faults.faults, has_no_zone=faults.has_no_zone)
    back_ns = step_ns // 2 if header.is_middle else 0
    for (line, cells), time_ns in zip(good, times_ns, strict=True):
        if time_ns is None:
            continue
        if (time_ns - back_ns) % step_ns:
            where = "middle" if header.is_middle else "start"
            rows.refuse(line, f"the time is not the {where} of a whole interval of {step_ns // HOUR_NS} h")
            continue
        values = _values(rows, line, [cells[column].strip() for column in header.values])
        if values is None:
            continue
        parts = (values[0], values[1]) if len(values) == 2 else None
        rows.add(line, time_ns - back_ns, sum(values), parts)
    return rows


def _step_ns(times_ns: Sequence[int], header: _Header) -> int:
    """Return the length of an interval: of Kp three hours where all times fit them, else one."""
    if header.name != "Kp" or not times_ns:
        return HOUR_NS
    back_ns = _KP_STEP_NS // 2 if header.is_middle else 0
    fits = all((time_ns - back_ns) % _KP_STEP_NS == 0 for time_ns in times_ns)
    return _KP_STEP_NS if fits else HOUR_NS


def _values(rows: Rows, line: int, cells: Sequence[str]) -> list[float] | None:
    values = []
    for cell in cells:
        number = number_of(cell) if cell else np.nan
        if number is None:
            rows.refuse(line, "want a number", cell)
            return None
        values.append(number)
    return values
