"""JSON columns: one object, a name and an array of cells for every column."""

from __future__ import annotations

import json
import re
from typing import Final

import pyarrow as pa
import pyarrow.json as pajson

from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry.columns import MAX_COLUMNS, PLAIN, ColumnMap, TableForm, checked_map, own_names, plan_columns
from magcal_core.telemetry.export import json_cells
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.json_cells import NOT_FINITE_TOKENS, has_infinite, parse_json, to_raw_table
from magcal_core.telemetry.json_rows import rows_to_raw
from magcal_core.telemetry.table import RawTable, from_arrow
from magcal_core.telemetry.table_format import TableCode
from magcal_core.telemetry.text import MAX_ROWS, check_row_count, checked_text
from magcal_core.telemetry.time_forms import time_columns

TABLE: Final = "JSON table"
_MAX_BYTES: Final = (1 << 31) - 2


def read_json_columns(
    data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS, form: TableForm = PLAIN
) -> RawTable:
    """Return the table in ``data``: ``{"time": [...], "bx": [...], ...}``, or a list of objects, one a row.

    An object whose only array is such a list, as services answer with, is that list.

    Raises
    ------
    InputError
        With every fault of the table, by row (counted from 1) and column.
    """
    text = checked_text(data)
    if len(text) > _MAX_BYTES:
        raise TelemetryFormatError("the JSON table is longer than 2 GiB; send Parquet or CSV")
    if text[:4096].lstrip().startswith(b"["):
        return _read_rows(text, columns, max_rows, form)
    table = _read_fast(text, checked_map(columns), form)
    if table is None:
        return _read_slowly(text, columns, max_rows, form)
    check_row_count(len(table), max_rows)
    return from_arrow(table, plan_columns(table.column_names, columns, table=TABLE, form=form), name=TABLE)


def _read_rows(text: bytes, columns: ColumnMap | None, max_rows: int, form: TableForm) -> RawTable:
    """Return a list of objects, one a row."""
    whole = parse_json(text, where="the JSON table")
    if not isinstance(whole, list) or not whole:
        raise TelemetryFormatError("the JSON table is a list without rows")
    return _of_rows(whole, columns, max_rows, form)


def _of_rows(whole: list[object], columns: ColumnMap | None, max_rows: int, form: TableForm) -> RawTable:
    check_row_count(len(whole), max_rows)
    faults = FaultList(TABLE)
    for number, row in enumerate(whole, 1):
        if not isinstance(row, dict):
            faults.add(TelemetryFormatError, f"row {number}", "not a JSON object")
    faults.raise_if_any()
    rows = [row for row in whole if isinstance(row, dict)]
    return rows_to_raw(rows, columns, form, row_word="row", table=TABLE)


def _read_fast(text: bytes, mapped: dict[str, str], form: TableForm) -> pa.Table | None:
    """Return the columns as Arrow parses them; None where they are not plain or have a fault."""
    # One object with one array a column: nothing else is nested, nothing for Arrow's parser to descend into.
    is_plain = text.count(b"{") == 1 and text.count(b"[") <= MAX_COLUMNS
    if not is_plain or any(token in text for token in NOT_FINITE_TOKENS):
        return None
    times = time_columns(form.times, mapped)
    types = {name: pa.float64() for name in own_names(mapped).values()}
    for name in times.own.values():
        types.pop(name, None)
        if _has_text_times(text, name):
            types[name] = pa.string()
        elif not times.is_declared:
            types[name] = pa.float64()
    if form.validity is not None:
        types.pop(form.validity.column, None)
    schema = pa.schema([(name, pa.list_(kind)) for name, kind in types.items()])
    try:
        whole = pajson.read_json(
            pa.BufferReader(text),
            read_options=pajson.ReadOptions(block_size=len(text) + 1),
            parse_options=pajson.ParseOptions(explicit_schema=schema, unexpected_field_behavior="infer"),
        )
        return _unfold(whole)  # lists in lists may have been read into columns that hold together no longer
    except pa.ArrowInvalid:
        return None


def _unfold(whole: pa.Table) -> pa.Table | None:
    """Return the one row of lists as a table; None where it is anything else or the lists differ in length."""
    if len(whole) != 1:
        return None
    cells = {}
    for name in whole.column_names:
        column = whole.column(name).chunk(0)
        if column.null_count:
            continue
        if not pa.types.is_list(column.type):
            return None
        cells[name] = column.flatten()
    if len({len(column) for column in cells.values()}) != 1:
        return None
    table = pa.table(cells)
    return None if has_infinite(table) else table


def _has_text_times(text: bytes, own: str) -> bool:
    begin = re.search(re.escape(json.dumps(own)).encode() + rb"\s*:\s*\[(?:\s|null|,)*", text)
    return begin is not None and text[begin.end() : begin.end() + 1] == b'"'


def _read_slowly(text: bytes, columns: ColumnMap | None, max_rows: int, form: TableForm) -> RawTable:
    """Return the columns, read cell by cell; raise with every fault among them."""
    whole = parse_json(text, where="the JSON table")
    if not isinstance(whole, dict):
        raise TelemetryFormatError('the JSON table is no object of arrays: want {"time": [...], "bx": [...], ...}')
    if (inside := _rows_inside(whole)) is not None:
        return _of_rows(inside, columns, max_rows, form)
    plan = plan_columns(list(whole), columns, table=TABLE, form=form)
    faults = FaultList(TABLE)
    for name, cells in whole.items():
        if not isinstance(cells, list):
            faults.add(TelemetryFormatError, f"column {name}", "not an array")
    faults.raise_if_any()
    lengths = {name: len(cells) for name, cells in whole.items()}
    rows = lengths[plan.time]
    for name, length in lengths.items():
        if length != rows:
            faults.add(TelemetryFormatError, f"column {name}", f"{length} cells, column {plan.time} has {rows}")
    faults.raise_if_any()
    check_row_count(rows, max_rows)
    return to_raw_table(whole, plan, row_word="row", table=TABLE)


def _rows_inside(whole: dict[str, object]) -> list[object] | None:
    """Return the rows of an answer such as ``{"count": 2, "data": [{..}, {..}]}``: its only array, if of objects."""
    arrays = [cells for cells in whole.values() if isinstance(cells, list)]
    if len(arrays) != 1 or not arrays[0] or not all(isinstance(row, dict) for row in arrays[0]):
        return None
    return arrays[0]


def write_json_columns(table: pa.Table) -> bytes:
    """Return a table of samples as JSON columns; an empty cell is null."""
    columns = (
        f"{json.dumps(name)}:[{','.join(json_cells(table.column(name)).to_pylist())}]" for name in table.column_names
    )
    return ("{" + ",\n".join(columns) + "}\n").encode()


def _arrow(data: bytes) -> pa.Table:
    return pa.table(json.loads(data))


CODE: Final = TableCode(read_json_columns, write_json_columns, _arrow)
