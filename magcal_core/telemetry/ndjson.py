"""NDJSON: one JSON object a line, one line a sample."""

from __future__ import annotations

import json
from typing import Final

import pyarrow as pa
import pyarrow.json as pajson

from magcal_core.errors import InputError, TelemetryFormatError
from magcal_core.telemetry.columns import MAX_COLUMNS, TIME, ColumnMap, checked_map, own_names, plan_columns
from magcal_core.telemetry.export import json_cells
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.json_cells import NOT_FINITE_TOKENS, has_infinite, parse_json, to_raw_table
from magcal_core.telemetry.table import RawTable, from_arrow
from magcal_core.telemetry.text import MAX_ROWS, check_lines, checked_text

TABLE: Final = "NDJSON table"
_BLOCK_BYTES: Final = 1 << 20


def read_ndjson(data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS) -> RawTable:
    """Return the table in ``data``: UTF-8 text, a flat JSON object a line.

    Raises
    ------
    InputError
        With every fault of the table, by line and column.
    """
    text = checked_text(data)
    check_lines(text, max_rows=max_rows)
    if not text.strip():
        raise TelemetryFormatError("the NDJSON table is empty")
    table = _read_fast(text, checked_map(columns))
    if table is None:
        return _read_slowly(text, columns)
    given = [name for name in table.column_names if table.column(name).null_count < len(table)]
    return from_arrow(table, plan_columns(given, columns, table=TABLE), name=TABLE)


def _read_fast(text: bytes, mapped: dict[str, str]) -> pa.Table | None:
    """Return the rows as Arrow parses them; None where they are not plain or have a fault."""
    # One object a line and no arrays: nothing nested, nothing for Arrow's parser to descend into.
    lines = text.count(b"\n") + (not text.endswith(b"\n"))
    if text.count(b"{") > lines or b"[" in text or any(token in text for token in NOT_FINITE_TOKENS):
        return None
    own = own_names(mapped)
    time_type = pa.float64() if _has_epoch_times(text, own[TIME]) else pa.string()
    schema = pa.schema(
        [(own[TIME], time_type), *((name, pa.float64()) for name in {*own.values()} - {own[TIME]})],
    )
    try:
        table = pajson.read_json(
            pa.BufferReader(text),
            read_options=pajson.ReadOptions(block_size=_BLOCK_BYTES),
            parse_options=pajson.ParseOptions(explicit_schema=schema, unexpected_field_behavior="infer"),
        )
    except pa.ArrowInvalid:
        return None
    return None if len(table.column_names) > MAX_COLUMNS or has_infinite(table) else table


def _has_epoch_times(text: bytes, own: str) -> bool:
    first_line = text.lstrip().split(b"\n", 1)[0]
    try:
        first = parse_json(first_line, where="line 1")
    except InputError:
        return False
    return isinstance(first, dict) and isinstance(first.get(own), int | float)


def _read_slowly(text: bytes, columns: ColumnMap | None) -> RawTable:
    """Return the rows, read one by one; raise with every fault among them."""
    faults = FaultList(TABLE)
    rows: list[dict[str, object]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = parse_json(line, where=f"line {number}")
        except InputError as error:
            faults.add(TelemetryFormatError, f"line {number}", error.message.removeprefix(f"line {number}: "))
            continue
        if isinstance(row, dict):
            rows.append(row)
        else:
            faults.add(TelemetryFormatError, f"line {number}", "not a JSON object")
    faults.raise_if_any()
    header = list({name: None for row in rows for name in row})
    plan = plan_columns(header, columns, table=TABLE)
    cells = {name: [row.get(name) for row in rows] for name in header}
    return to_raw_table(cells, plan, row_word="line", table=TABLE)


def write_ndjson(table: pa.Table) -> bytes:
    """Return a table of samples as NDJSON; an empty cell is null."""
    import pyarrow.compute as pc

    parts: list[object] = []
    for i, name in enumerate(table.column_names):
        parts += [f"{'{' if i == 0 else ','}{json.dumps(name)}:", json_cells(table.column(name))]
    lines = pc.binary_join_element_wise(*parts, "}", "")
    return "".join(f"{line}\n" for line in lines.to_pylist()).encode()
