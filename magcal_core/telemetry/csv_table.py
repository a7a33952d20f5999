"""CSV: a header row, then one row a sample; comma, semicolon, tab or blanks."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from magcal_core.arrays import Floats
from magcal_core.errors import InputError, TelemetryFormatError, TelemetryValueError
from magcal_core.telemetry import yamcs
from magcal_core.telemetry.columns import (
    PLAIN,
    STANDARD,
    TIME,
    ColumnMap,
    ColumnPlan,
    TableForm,
    normal_header,
    plan_columns,
)
from magcal_core.telemetry.csv_layout import Layout, find_layout, with_tabs
from magcal_core.telemetry.declared_times import declared_times
from magcal_core.telemetry.export import is_text, iso_texts
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.iso_times import is_number
from magcal_core.telemetry.long_table import LongColumns, long_columns, long_to_raw
from magcal_core.telemetry.table import EMPTY_CELLS, RawTable, from_arrow
from magcal_core.telemetry.table_format import TableCode
from magcal_core.telemetry.text import MAX_ROWS, check_lines, checked_text
from magcal_core.telemetry.time_forms import is_time_key
from magcal_core.telemetry.times import parse_times

TABLE: Final = "CSV table"
_BLOCK_BYTES: Final = 1 << 20
_NOT_FINITE: Final = ("nan", "inf", "infinity")
_FORMULA: Final = ("=", "+", "-", "@", "\t", "\r")


def read_csv(
    data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS, form: TableForm = PLAIN
) -> RawTable:
    """Return the table in ``data``: UTF-8 text with a header row.

    Raises
    ------
    InputError
        With every fault of the table, by line and column.
    """
    text = checked_text(data)
    check_lines(text, max_rows=max_rows)
    text = with_tabs(text)
    layout = find_layout(text)
    header = normal_header(layout.header)
    if not text[layout.start : layout.start + 4096].strip() and not text[layout.start :].strip():
        raise TelemetryFormatError("the CSV table has a header and no rows")
    if (long := long_columns(header, columns)) is not None:
        table, bad_rows = _long_rows(text, layout, header, long)
        return replace(long_to_raw(table, long, columns, form, name=f"long {TABLE}"), bad_rows=bad_rows)
    is_yamcs = yamcs.is_export(header)
    named = yamcs.column_map(header, columns) if is_yamcs else _timed(layout, columns, form)
    raw = _read_wide(text, layout, header, plan_columns(header, named, table=TABLE, form=form))
    return yamcs.at_readings(raw) if is_yamcs else raw


def _timed(layout: Layout, columns: ColumnMap | None, form: TableForm) -> ColumnMap | None:
    """Return the column map with the time that the header itself tells."""
    if layout.time is None or form.times.name or any(is_time_key(key) for key in columns or {}):
        return columns
    return {TIME: layout.time, **(columns or {})}


def _read_wide(text: bytes, layout: Layout, header: list[str], plan: ColumnPlan) -> RawTable:
    body = memoryview(text)[layout.start :]
    table, bad_rows = _read_fast(body, header, layout, plan), 0
    if table is None:
        cleaned, bad_rows = _without_bad_rows(text[layout.start :], layout, len(header))
        table = _read_fast(memoryview(cleaned), header, layout, plan) if bad_rows else None
    if table is not None and not plan.times.is_declared:
        raw = from_arrow(table, plan, name=TABLE)
    elif table is not None:
        try:
            raw = from_arrow(table, plan, name=TABLE)
        except InputError:
            # The rows of the fast pass have no numbers of lines: the slow one names each fault by its own.
            return _read_slowly(text[layout.start :], header, layout, plan)
    else:
        return _read_slowly(text[layout.start :], header, layout, plan)
    numbers = {name: _without_fill(column, layout.fills.get(own)) for own, name, column in _owned(raw, plan)}
    return replace(raw, numbers=numbers, bad_rows=bad_rows)


def _owned(raw: RawTable, plan: ColumnPlan) -> Iterator[tuple[str, str, Floats]]:
    own = {name: own for own, name in {**plan.housekeeping, **plan.numbers}.items()}
    return ((own[name], name, column) for name, column in raw.numbers.items())


def _without_fill(column: Floats, fill: float | None) -> Floats:
    return column if fill is None else np.where(column == fill, np.nan, column)


def _long_rows(text: bytes, layout: Layout, header: list[str], long: LongColumns) -> tuple[pa.Table, int]:
    """Return the three columns of a long table as text, and how many rows are none."""
    types = dict.fromkeys((long.time, long.parameter, long.value), pa.string())
    body, bad_rows = text[layout.start :], 0
    table = _arrow_rows(memoryview(body), header, layout, types)
    if table is None:
        body, bad_rows = _without_bad_rows(body, layout, len(header))
        table = _arrow_rows(memoryview(body), header, layout, types)
    if table is None:
        faults = FaultList(f"long {TABLE}")
        _rows(text[layout.start :].decode("utf-8"), header, layout, faults)
        faults.raise_if_any()
        raise TelemetryFormatError(f"the long {TABLE} has rows that cannot be parted into cells")
    return table, bad_rows


def _read_fast(body: memoryview, header: list[str], layout: Layout, plan: ColumnPlan) -> pa.Table | None:
    """Return the rows as Arrow parses them, columns under their own names; None where it finds a fault."""
    validity = None if plan.validity is None else plan.validity.column
    wanted = [own for own in header if own in plan.names or own in plan.housekeeping or own == validity]
    types: dict[str, pa.DataType | None] = dict.fromkeys(wanted)
    types |= dict.fromkeys(plan.numbers, pa.float64())
    if validity is not None:
        types[validity] = pa.string()
    if plan.times.is_declared:
        types |= dict.fromkeys(plan.times.own.values(), pa.string())
    else:
        is_epoch = _has_epoch_times(body, layout.separator, header.index(plan.time))
        types[plan.time] = pa.float64() if is_epoch else pa.timestamp("ns", "UTC")
    return _arrow_rows(body, header, layout, types)


def _arrow_rows(
    body: memoryview, header: list[str], layout: Layout, types: Mapping[str, pa.DataType | None]
) -> pa.Table | None:
    """Return the columns in ``types`` under their own names; those of type None have what Arrow finds in them."""
    keys = [str(i) for i in range(len(header))]
    own = {key: name for key, name in zip(keys, header, strict=True) if name in types}
    try:
        table = pacsv.read_csv(
            pa.BufferReader(pa.py_buffer(body)),
            read_options=pacsv.ReadOptions(column_names=keys, block_size=_BLOCK_BYTES),
            parse_options=pacsv.ParseOptions(delimiter=layout.separator),
            convert_options=pacsv.ConvertOptions(
                column_types={key: types[name] for key, name in own.items() if types[name] is not None},
                include_columns=list(own),
                null_values=list(EMPTY_CELLS),
                strings_can_be_null=True,
                decimal_point=layout.decimal,
            ),
        )
    except pa.ArrowInvalid:
        return None
    return table.rename_columns(list(own.values()))


def _has_epoch_times(body: memoryview, separator: str, column: int) -> bool:
    """Return whether the first time cell that is not empty is a number."""
    for line in io.BytesIO(bytes(body[: 1 << 16])):
        cells = line.decode("utf-8", "replace").rstrip("\r\n").split(separator)
        cell = cells[column].strip(' "') if column < len(cells) else ""
        if cell and cell not in EMPTY_CELLS:
            return is_number(cell) or (separator != "," and is_number(cell.replace(",", ".")))
    return False


def _without_bad_rows(body: bytes, layout: Layout, width: int) -> tuple[bytes, int]:
    """Return the rows without headers among them and without a last row that is cut, and how many went."""
    bad, kept = 0, body
    header = layout.header_line.strip().encode()
    if header and header in body:
        lines = body.splitlines(keepends=True)
        rows = [line for line in lines if not _is_header(line, header)]
        kept, bad = b"".join(rows), len(lines) - len(rows)
    last = kept.rstrip(b"\r\n")
    at = max(last.rfind(b"\n"), last.rfind(b"\r")) + 1
    if at and _is_cut(last[at:].decode("utf-8"), layout.separator, width):
        kept, bad = kept[:at], bad + 1
    return kept, bad


def _is_header(line: bytes, header: bytes) -> bool:
    return line.strip().lstrip(b"# \t\xef\xbb\xbf") == header


def _is_cut(line: str, separator: str, width: int) -> bool:
    """Return whether a last line ends before its last cell begins."""
    return line.count(separator) + 1 < width


def _read_slowly(body: bytes, header: list[str], layout: Layout, plan: ColumnPlan) -> RawTable:
    """Return the rows, read one by one; raise with every fault among them."""
    faults = FaultList(TABLE)
    rows, bad_rows = _rows(body.decode("utf-8"), header, layout, faults)
    place = {own: i for i, own in enumerate(header)}
    is_epoch, scale = False, None
    if plan.times.is_declared:
        parts = {part: _texts([row[place[own]] for _, row in rows]) for part, own in plan.times.own.items()}
        t_ns, scale = declared_times(plan.times, parts, lambda i: f"line {rows[i][0]}, column {plan.time}", faults)
    else:
        cells = [(f"line {line}, column {plan.time}", _cell(row[place[plan.time]])) for line, row in rows]
        if layout.separator != ",":
            cells = [(where, text and _pointed(text)) for where, text in cells]
        is_epoch = is_number(next((text for _, text in cells if text), ""))
        t_ns = parse_times(cells, faults, plan.times.form.spans)
    numbers: dict[str, Floats] = {}
    for own, name in plan.numbers.items():
        column = _numbers([(line, row[place[own]]) for line, row in rows], own, faults, layout)
        numbers[name] = _without_fill(column, layout.fills.get(own))
    faults.raise_if_any()
    kept, ignored = _housekeeping(rows, plan.housekeeping, place, layout)
    good = (
        None if plan.validity is None else plan.validity.is_good([row[place[plan.validity.column]] for _, row in rows])
    )
    return RawTable(t_ns, is_epoch, numbers | kept, ignored, scale, good, bad_rows)


def _texts(cells: list[str]) -> pa.ChunkedArray:
    return pa.chunked_array([pa.array([_cell(cell) for cell in cells], pa.string())])


def _pointed(text: str) -> str:
    """Return a number with a decimal comma with a point, other text as it is."""
    return text.replace(",", ".") if is_number(text.replace(",", ".")) else text


def _rows(text: str, header: list[str], layout: Layout, faults: FaultList) -> tuple[list[tuple[int, list[str]]], int]:
    """Return line number and cells of every row of the right width, and how many lines are bad rows.

    A header that stands there once more, and a last line that ends early, are bad rows rather than faults.
    """
    lines = [
        (i, line) for i, line in enumerate(io.StringIO(text, newline=None), layout.first_line) if line.strip("\r\n")
    ]
    rows: list[tuple[int, list[str]]] = []
    bad_rows, names = 0, layout.header_line.strip().encode()
    for line_number, line in lines:
        where = f"line {line_number}"
        if names and _is_header(line.encode(), names):
            bad_rows += 1
            continue
        try:
            row = next(csv.reader([line.rstrip("\r\n")], delimiter=layout.separator, strict=True))
        except csv.Error as error:
            faults.add(TelemetryFormatError, where, f"broken quoting: {error}")
            continue
        if len(row) == len(header):
            rows.append((line_number, row))
        elif len(row) < len(header) and rows and line_number == lines[-1][0]:
            bad_rows += 1
        else:
            faults.add(TelemetryFormatError, where, f"{len(row)} cells, the header has {len(header)}")
    return rows, bad_rows


def _cell(text: str) -> str | None:
    stripped = text.strip()
    return None if stripped in EMPTY_CELLS or _is_not_finite(stripped) else stripped


def _is_not_finite(text: str) -> bool:
    return text.lower().lstrip("+-") in _NOT_FINITE


def _number(text: str, layout: Layout) -> float | None:
    """Return the number in a cell, NaN for an empty one, None for anything else."""
    stripped = text.strip()
    if stripped in EMPTY_CELLS:
        return float("nan")
    plain = stripped if layout.separator == "," else _pointed(stripped)
    if is_number(plain) or _is_not_finite(plain):
        return float(plain)
    return None


def _numbers(cells: list[tuple[int, str]], own: str, faults: FaultList, layout: Layout) -> Floats:
    values = np.full(len(cells), np.nan)
    for i, (line, text) in enumerate(cells):
        value = _number(text, layout)
        if value is None:
            faults.add(TelemetryValueError, f"line {line}, column {own}", "not a number", text)
        else:
            values[i] = value
    return values


def _housekeeping(
    rows: list[tuple[int, list[str]]], housekeeping: Mapping[str, str], place: Mapping[str, int], layout: Layout
) -> tuple[dict[str, Floats], tuple[str, ...]]:
    """Return the numeric columns among the rest, and the names of those that are not."""
    kept: dict[str, Floats] = {}
    ignored = []
    for own, name in housekeeping.items():
        values = [_number(row[place[own]], layout) for _, row in rows]
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


def _arrow(data: bytes) -> pa.Table:
    return pacsv.read_csv(pa.BufferReader(data))


CODE: Final = TableCode(read_csv, write_csv, _arrow)
