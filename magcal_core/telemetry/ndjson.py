"""NDJSON: one JSON object a line, one line a sample."""

from __future__ import annotations

import json
from typing import Final

import pyarrow as pa
import pyarrow.json as pajson

from magcal_core.errors import InputError, TelemetryFormatError
from magcal_core.telemetry.columns import MAX_COLUMNS, PLAIN, ColumnMap, TableForm, checked_map, own_names, plan_columns
from magcal_core.telemetry.export import json_cells
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.json_cells import NOT_FINITE_TOKENS, has_infinite, parse_json
from magcal_core.telemetry.json_rows import rows_to_raw
from magcal_core.telemetry.long_table import long_columns
from magcal_core.telemetry.table import RawTable, from_arrow
from magcal_core.telemetry.table_format import TableCode
from magcal_core.telemetry.text import MAX_ROWS, check_lines, checked_text
from magcal_core.telemetry.time_forms import time_columns

TABLE: Final = "NDJSON table"
_BLOCK_BYTES: Final = 1 << 20


def read_ndjson(
    data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS, form: TableForm = PLAIN
) -> RawTable:
    """Return the table in ``data``: UTF-8 text, a JSON object a line.

    Raises
    ------
    InputError
        With every fault of the table, by line and column.
    """
    text = checked_text(data)
    check_lines(text, max_rows=max_rows)
    if not text.strip():
        raise TelemetryFormatError("the NDJSON table is empty")
    table = _read_fast(text, checked_map(columns), form)
    if table is None:
        return _read_slowly(text, columns, form)
    given = [name for name in table.column_names if table.column(name).null_count < len(table)]
    if long_columns(given, columns) is not None:
        return _read_slowly(text, columns, form)
    return from_arrow(table, plan_columns(given, columns, table=TABLE, form=form), name=TABLE)


def _read_fast(text: bytes, mapped: dict[str, str], form: TableForm) -> pa.Table | None:
    """Return the rows as Arrow parses them; None where they are not plain or have a fault."""
    # One object a line and no arrays: nothing nested, nothing for Arrow's parser to descend into.
    lines = text.count(b"\n") + (not text.endswith(b"\n"))
    if text.count(b"{") > lines or b"[" in text or any(token in text for token in NOT_FINITE_TOKENS):
        return None
    own = own_names(mapped)
    first = _first_row(text)
    times = time_columns(form.times, mapped)
    types = {name: pa.float64() for name in own.values()}
    types |= {name: pa.string() for name in times.own.values()}
    for name in times.own.values():
        if isinstance(first.get(name), int | float) and not times.is_declared:
            types[name] = pa.float64()
        elif isinstance(first.get(name), int | float):
            # Whole numbers of a declared form are kept whole: nanoseconds since 1970 are more than a double holds.
            del types[name]
    if form.validity is not None:
        types.pop(form.validity.column, None)
    schema = pa.schema(list(types.items()))
    try:
        table = pajson.read_json(
            pa.BufferReader(text),
            read_options=pajson.ReadOptions(block_size=_BLOCK_BYTES),
            parse_options=pajson.ParseOptions(explicit_schema=schema, unexpected_field_behavior="infer"),
        )
    except pa.ArrowInvalid:
        return None
    return None if len(table.column_names) > MAX_COLUMNS or has_infinite(table) else table


def _first_row(text: bytes) -> dict[str, object]:
    first_line = text.lstrip().split(b"\n", 1)[0]
    try:
        first = parse_json(first_line, where="line 1")
    except InputError:
        return {}
    return first if isinstance(first, dict) else {}


def _read_slowly(text: bytes, columns: ColumnMap | None, form: TableForm) -> RawTable:
    """Return the rows, read one by one; raise with every fault among them. A last line that is cut is a bad row."""
    faults = FaultList(TABLE)
    rows: list[dict[str, object]] = []
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    bad_rows = 0
    for number, line in lines:
        try:
            row = parse_json(line, where=f"line {number}")
        except InputError as error:
            if rows and number == lines[-1][0] and _is_cut(line):
                bad_rows += 1
            else:
                faults.add(TelemetryFormatError, f"line {number}", error.message.removeprefix(f"line {number}: "))
            continue
        if isinstance(row, dict):
            rows.append(row)
        else:
            faults.add(TelemetryFormatError, f"line {number}", "not a JSON object")
    faults.raise_if_any()
    return rows_to_raw(rows, columns, form, row_word="line", table=TABLE, bad_rows=bad_rows)


def _is_cut(line: bytes) -> bool:
    """Return whether an object begins and does not end."""
    plain = line.strip()
    return plain.startswith(b"{") and not plain.endswith(b"}") and plain.count(b"{") > plain.count(b"}")


def write_ndjson(table: pa.Table) -> bytes:
    """Return a table of samples as NDJSON; an empty cell is null."""
    import pyarrow.compute as pc

    parts: list[object] = []
    for i, name in enumerate(table.column_names):
        parts += [f"{'{' if i == 0 else ','}{json.dumps(name)}:", json_cells(table.column(name))]
    lines = pc.binary_join_element_wise(*parts, "}", "")
    return "".join(f"{line}\n" for line in lines.to_pylist()).encode()


def _arrow(data: bytes) -> pa.Table:
    return pajson.read_json(pa.BufferReader(data))


CODE: Final = TableCode(read_ndjson, write_ndjson, _arrow)
