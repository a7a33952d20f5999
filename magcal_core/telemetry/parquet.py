"""Parquet: a column a name, a row a sample."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pyarrow as pa

from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry.columns import ColumnMap, plan_columns
from magcal_core.telemetry.table import RawTable, from_arrow
from magcal_core.telemetry.text import MAX_ROWS, check_row_count

if TYPE_CHECKING:
    from pyarrow.parquet import FileMetaData

TABLE: Final = "Parquet table"
MAX_BYTES_PER_CELL: Final = 256
"""Decompressed bytes a cell that a file may claim; numbers need 8, ISO times 30."""


def read_parquet(data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS) -> RawTable:
    """Return the table in ``data``; nested columns are ignored.

    Raises
    ------
    InputError
        The file is cut short, corrupt or past a limit, or with every fault of the table, by row and column.
    """
    from pyarrow.parquet import ParquetFile

    try:
        file = ParquetFile(pa.BufferReader(data))
        check_row_count(file.metadata.num_rows, max_rows)
        schema = file.schema_arrow
        flat = [name for name, kind in zip(schema.names, schema.types, strict=True) if not pa.types.is_nested(kind)]
        plan = plan_columns([name.strip() for name in schema.names], columns, table=TABLE)
        _check_size(file.metadata)
        for name in plan.names:
            if name not in {flat_name.strip() for flat_name in flat}:
                raise TelemetryFormatError(f"column {name} of the Parquet table is nested, want numbers")
        numeric = {name for name in flat if _may_be_numeric(schema.field(name).type)}
        own = {name.strip(): name for name in flat}
        ignored = tuple(name for name in plan.housekeeping if own.get(name) not in numeric)
        wanted = [own[name] for name in (*plan.names, *plan.housekeeping) if name in own and name not in ignored]
        table = file.read(columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise TelemetryFormatError(f"the Parquet file is cut short or corrupt: {str(error)[:120]}") from error
    if len(table) == 0:
        raise TelemetryFormatError("the Parquet table has no rows")
    table = table.rename_columns([name.strip() for name in table.column_names])
    kept = {name: keeping for name, keeping in plan.housekeeping.items() if name not in ignored}
    raw = from_arrow(table, type(plan)(plan.names, kept), name=TABLE)
    return RawTable(raw.t_ns, raw.is_epoch, raw.numbers, (*ignored, *raw.ignored))


def _check_size(metadata: FileMetaData) -> None:
    for i in range(metadata.num_row_groups):
        group = metadata.row_group(i)
        if group.total_byte_size > MAX_BYTES_PER_CELL * (group.num_rows + 4096) * max(group.num_columns, 1):
            raise TelemetryFormatError(f"row group {i} of the Parquet file claims {group.total_byte_size} bytes")


def _may_be_numeric(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def write_parquet(table: pa.Table) -> bytes:
    """Return a table of samples as Parquet, zstd inside."""
    from pyarrow.parquet import write_table

    body = pa.BufferOutputStream()
    write_table(table, body, compression="zstd", use_dictionary=False)
    return bytes(body.getvalue())
