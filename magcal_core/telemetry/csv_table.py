"""CSV: a header row, then one row a sample; comma, semicolon or tab."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from magcal_core.arrays import Floats
from magcal_core.errors import TelemetryFormatError, TelemetryValueError
from magcal_core.telemetry import yamcs
from magcal_core.telemetry.columns import STANDARD, ColumnMap, ColumnPlan, normal_header, plan_columns
from magcal_core.telemetry.export import is_text, iso_texts
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.table import EMPTY_CELLS, RawTable, from_arrow
from magcal_core.telemetry.text import MAX_ROWS, check_lines, checked_text
from magcal_core.telemetry.times import is_number, parse_times

TABLE: Final = "CSV table"
SEPARATORS: Final = ",;\t"
_BLOCK_BYTES: Final = 1 << 20
_NOT_FINITE: Final = ("nan", "inf", "infinity")
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r")


def read_csv(data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS) -> RawTable:
    """Return the table in ``data``: UTF-8 text with a header row.

    Raises
    ------
    InputError
        With every fault of the table, by line and column.
    """
    text = checked_text(data)
    check_lines(text, max_rows=max_rows)
    start, header_line, lines_above = _find_header(text)
    separator = _separator(header_line)
    header = normal_header(_split(header_line, separator))
    is_yamcs = yamcs.is_export(header)
    plan = plan_columns(header, yamcs.column_map(header, columns) if is_yamcs else columns, table=TABLE)
    body = memoryview(text)[start:]
    if not text[start : start + 4096].strip() and not text[start:].strip():
        raise TelemetryFormatError("the CSV table has a header and no rows")
    table = _read_fast(body, header, separator, plan)
    if table is None:
        raw = _read_slowly(text[start:], header, separator, plan, first_line=lines_above + 2)
    else:
        raw = from_arrow(table, plan, name=TABLE)
    return yamcs.at_readings(raw) if is_yamcs else raw


def _find_header(text: bytes) -> tuple[int, str, int]:
    """Return where the rows begin, the header line, and the number of lines above it: blank ones and # comments."""
    at, above = 0, 0
    while at < len(text):
        newline = text.find(b"\n", at)
        end = text.find(b"\r", at, None if newline < 0 else newline)
        end = end if end >= 0 else newline if newline >= 0 else len(text)
        line = text[at:end].decode("utf-8").strip("\ufeff")
        at = end + (2 if text[end : end + 2] == b"\r\n" else 1)
        if line.strip() and not line.startswith("#"):
            return min(at, len(text)), line, above
        above += 1
    raise TelemetryFormatError("the CSV table is empty: no header row")


def _separator(header_line: str) -> str:
    return max(SEPARATORS, key=header_line.count)


def _split(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator, strict=True, skipinitialspace=separator != "\t"), [])
    except csv.Error as error:
        raise TelemetryFormatError(f"line {line[:40]!r}: {error}") from error


def _read_fast(body: memoryview, header: list[str], separator: str, plan: ColumnPlan) -> pa.Table | None:
    """Return the rows as Arrow parses them, columns under their own names; None where it finds a fault."""
    keys = [str(i) for i in range(len(header))]
    wanted = {key: own for key, own in zip(keys, header, strict=True) if own in plan.names or own in plan.housekeeping}
    time_key = keys[header.index(plan.time)]
    numbers = {key: pa.float64() for key, own in wanted.items() if own in plan.numbers}
    time_type = pa.float64() if _has_epoch_times(body, separator, int(time_key)) else pa.timestamp("ns", "UTC")
    try:
        table = pacsv.read_csv(
            pa.BufferReader(pa.py_buffer(body)),
            read_options=pacsv.ReadOptions(column_names=keys, block_size=_BLOCK_BYTES),
            parse_options=pacsv.ParseOptions(delimiter=separator),
            convert_options=pacsv.ConvertOptions(
                column_types={time_key: time_type, **numbers},
                include_columns=list(wanted),
                null_values=list(EMPTY_CELLS),
                strings_can_be_null=True,
            ),
        )
    except pa.ArrowInvalid:
        return None
    return table.rename_columns(list(wanted.values()))


def _has_epoch_times(body: memoryview, separator: str, column: int) -> bool:
    """Return whether the first time cell that is not empty is a number."""
    for line in io.BytesIO(bytes(body[: 1 << 16])):
        cells = line.decode("utf-8", "replace").rstrip("\r\n").split(separator)
        cell = cells[column].strip(' "') if column < len(cells) else ""
        if cell and cell not in EMPTY_CELLS:
            return is_number(cell)
    return False


def _read_slowly(body: bytes, header: list[str], separator: str, plan: ColumnPlan, *, first_line: int) -> RawTable:
    """Return the rows, read one by one; raise with every fault among them."""
    faults = FaultList(TABLE)
    rows = list(_rows(body.decode("utf-8"), len(header), separator, first_line, faults))
    place = {own: i for i, own in enumerate(header)}
    time_at = place[plan.time]
    cells = [(f"line {line}, column {plan.time}", _cell(row[time_at])) for line, row in rows]
    is_epoch = is_number(next((text for _, text in cells if text), ""))
    t_ns = parse_times(cells, faults)
    numbers: dict[str, Floats] = {}
    for own, name in plan.numbers.items():
        numbers[name] = _numbers([(line, row[place[own]]) for line, row in rows], own, faults)
    faults.raise_if_any()
    kept, ignored = _housekeeping(rows, plan.housekeeping, place)
    return RawTable(t_ns, is_epoch, numbers | kept, ignored)


def _rows(text: str, width: int, separator: str, first_line: int, faults: FaultList) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of every row of the right width."""
    for line_number, line in enumerate(io.StringIO(text, newline=None), first_line):
        if not line.strip("\r\n"):
            continue
        where = f"line {line_number}"
        try:
            row = next(csv.reader([line.rstrip("\r\n")], delimiter=separator, strict=True))
        except csv.Error as error:
            faults.add(TelemetryFormatError, where, f"broken quoting: {error}")
            continue
        if len(row) == width:
            yield line_number, row
        else:
            faults.add(TelemetryFormatError, where, f"{len(row)} cells, the header has {width}")


def _cell(text: str) -> str | None:
    stripped = text.strip()
    return None if stripped in EMPTY_CELLS or _is_not_finite(stripped) else stripped


def _is_not_finite(text: str) -> bool:
    return text.lower().lstrip("+-") in _NOT_FINITE


def _number(text: str) -> float | None:
    """Return the number in a cell, NaN for an empty one, None for anything else."""
    stripped = text.strip()
    if stripped in EMPTY_CELLS:
        return float("nan")
    if is_number(stripped) or _is_not_finite(stripped):
        return float(stripped)
    return None


def _numbers(cells: list[tuple[int, str]], own: str, faults: FaultList) -> Floats:
    values = np.full(len(cells), np.nan)
    for i, (line, text) in enumerate(cells):
        value = _number(text)
        if value is None:
            faults.add(TelemetryValueError, f"line {line}, column {own}", "not a number", text)
        else:
            values[i] = value
    return values


def _housekeeping(
    rows: list[tuple[int, list[str]]], housekeeping: Mapping[str, str], place: Mapping[str, int]
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """Return the numeric columns among the rest, and the names of those that are not."""
    kept: dict[str, Floats] = {}
    ignored = []
    for own, name in housekeeping.items():
        values = [_number(row[place[own]]) for _, row in rows]
        column = np.array([np.nan if value is None else value for value in values])
        if None in values or np.isnan(column).all():
            ignored.append(own)
        else:
            kept[name] = column
    return kept, tuple(ignored)


def write_csv(table: pa.Table) -> bytes:
    """Return a table as CSV; text that a spreadsheet would run as a formula gets a leading apostrophe."""
    names = [name if name in STANDARD else harmless(name) for name in table.column_names]
    head = io.StringIO()
    csv.writer(head, lineterminator="\n").writerow(names)
    columns = [iso_texts(column) if pa.types.is_timestamp(column.type) else column for column in table.columns]
    if any(is_text(column) for column in table.columns):
        return head.getvalue().encode() + _text_rows(columns)
    body = io.BytesIO()
    options = pacsv.WriteOptions(include_header=False, quoting_style="none")
    pacsv.write_csv(pa.table(columns, [str(i) for i in range(len(columns))]), body, options)
    return head.getvalue().encode() + body.getvalue()


def harmless(text: str) -> str:
    """Return a text cell, with an apostrophe before it where a spreadsheet would run it as a formula."""
    return f"'{text}" if text.startswith(_FORMULA) else text


def _text_rows(columns: list[pa.ChunkedArray]) -> bytes:
    """Return rows with text among their cells; Arrow would quote every text, times included."""
    cells = [
        ["" if text is None else harmless(text) for text in column.cast(pa.string()).to_pylist()]
        if is_text(column)
        else ["" if value is None else value for value in column.to_pylist()]
        for column in columns
    ]
    body = io.StringIO()
    csv.writer(body, lineterminator="\n").writerows(zip(*cells, strict=True))
    return body.getvalue().encode()
