"""Parquet: a column a name, a row a sample."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import pyarrow as pa

from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry.columns import PLAIN, ColumnMap, TableForm, plan_columns
from magcal_core.telemetry.long_table import LongColumns, long_columns, long_to_raw
from magcal_core.telemetry.table import RawTable, from_arrow
from magcal_core.telemetry.table_format import TableCode
from magcal_core.telemetry.text import MAX_ROWS, check_row_count

if TYPE_CHECKING:
    from pyarrow.parquet import FileMetaData, ParquetFile

TABLE: Final = "Parquet table"
MAX_BYTES_PER_CELL: Final = 256
"""Decompressed bytes a cell that a file may claim; numbers need 8, ISO times 30."""


def read_parquet(
    data: bytes, columns: ColumnMap | None = None, *, max_rows: int = MAX_ROWS, form: TableForm = PLAIN
) -> RawTable:
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
        stripped = [name.strip() for name in schema.names]
        if (long := long_columns(stripped, columns)) is not None:
            return _read_long(file, long, columns, form)
        plan = plan_columns(stripped, columns, table=TABLE, form=form)
        _check_size(file.metadata)
        for name in plan.names:
            if name not in {flat_name.strip() for flat_name in flat}:
                raise TelemetryFormatError(f"column {name} of the Parquet table is nested, want numbers")
        numeric = {name for name in flat if _may_be_numeric(schema.field(name).type)}
        own = {name.strip(): name for name in flat}
        ignored = tuple(name for name in plan.housekeeping if own.get(name) not in numeric)
        told = () if plan.validity is None else (plan.validity.column,)
        names = dict.fromkeys((*plan.names, *plan.housekeeping, *told))
        wanted = [own[name] for name in names if name in own and name not in ignored]
        table = file.read(columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise TelemetryFormatError(f"the Parquet file is cut short or corrupt: {str(error)[:120]}") from error
    if len(table) == 0:
        raise TelemetryFormatError("the Parquet table has no rows")
    table = table.rename_columns([name.strip() for name in table.column_names])
    kept = {name: keeping for name, keeping in plan.housekeeping.items() if name not in ignored}
    raw = from_arrow(table, replace(plan, housekeeping=kept), name=TABLE)
    return replace(raw, ignored=(*ignored, *raw.ignored))


def _read_long(file: ParquetFile, long: LongColumns, columns: ColumnMap | None, form: TableForm) -> RawTable:
    _check_size(file.metadata)
    own = {name.strip(): name for name in file.schema_arrow.names}
    table = file.read(columns=[own[name] for name in (long.time, long.parameter, long.value)])
    plain = table.rename_columns([name.strip() for name in table.column_names])
    return long_to_raw(plain, long, columns, form, name=f"long {TABLE}")


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


def _arrow(data: bytes) -> pa.Table:
    from pyarrow.parquet import read_table

    return read_table(pa.BufferReader(data))


CODE: Final = TableCode(read_parquet, write_parquet, _arrow)
