"""The first rows of a table as they stand there, nothing taken for anything: for whoever names its columns."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

import pyarrow as pa

from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry.columns import MAX_COLUMNS, normal_header
from magcal_core.telemetry.csv_layout import find_layout, split_line
from magcal_core.telemetry.formats import format_of_bytes
from magcal_core.telemetry.json_cells import parse_json
from magcal_core.telemetry.text import checked_text

ROWS: Final = 5
MOST_CELL: Final = 80
"""Characters of a cell that are shown."""


@dataclass(frozen=True, slots=True)
class FirstRows:
    """The beginning of a table.

    Attributes
    ----------
    format : the format that it was read as.
    header : names of the columns, stripped.
    rows : cells of the first rows as text, as many as the header has.
    """

    format: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


def first_rows(data: bytes, form: str | None = None, most: int = ROWS) -> FirstRows:
    """Return the header and at most ``most`` rows of the table in ``data``, which is not compressed.

    Raises
    ------
    InputError
        It has no header, or is none of the formats of telemetry.
    """
    kind = form or format_of_bytes(data)
    if kind == "parquet":
        header, rows = _parquet(data, most)
    else:
        text = checked_text(data)
        header, rows = {"csv": _csv, "ndjson": _ndjson, "json": _json}[kind](text, most)
    if len(header) > MAX_COLUMNS:
        raise TelemetryFormatError(f"the table has {len(header)} columns; the limit is {MAX_COLUMNS}")
    wide = [(*row, *[""] * len(header))[: len(header)] for row in rows]
    return FirstRows(kind, normal_header(header), [[cell[:MOST_CELL] for cell in row] for row in wide])


def _csv(text: bytes, most: int) -> tuple[Sequence[str], list[list[str]]]:
    layout = find_layout(text)
    rows: list[list[str]] = []
    at = layout.start
    while at < len(text) and len(rows) < most:
        end = text.find(b"\n", at)
        end = len(text) if end < 0 else end
        line = text[at:end].decode("utf-8").rstrip("\r")
        at = end + 1
        if line.strip():
            rows.append(split_line(line, layout.separator))
    return layout.header, rows


def _ndjson(text: bytes, most: int) -> tuple[Sequence[str], list[list[str]]]:
    lines = (line for line in text.split(b"\n", most * 10) if line.strip())
    return _objects([parse_json(line, where=f"line {i}") for i, line in enumerate(islice(lines, most), 1)])


def _json(text: bytes, most: int) -> tuple[Sequence[str], list[list[str]]]:
    whole = parse_json(text, where="the JSON table")
    if isinstance(whole, list):
        return _objects(whole[:most])
    if not isinstance(whole, dict):
        raise TelemetryFormatError("the JSON table is neither columns nor rows")
    columns = [cells[:most] if isinstance(cells, list) else [] for cells in whole.values()]
    count = max(map(len, columns), default=0)
    return list(whole), [[_text(cells[i]) if i < len(cells) else "" for cells in columns] for i in range(count)]


def _objects(rows: Sequence[object]) -> tuple[Sequence[str], list[list[str]]]:
    objects: list[Mapping[str, object]] = [row for row in rows if isinstance(row, dict)]
    if not objects:
        raise TelemetryFormatError("the table has no row that is a JSON object")
    header = list(dict.fromkeys(name for row in objects for name in row))
    return header, [[_text(row.get(name)) for name in header] for row in objects]


def _parquet(data: bytes, most: int) -> tuple[Sequence[str], list[list[str]]]:
    from pyarrow.parquet import ParquetFile

    try:
        file = ParquetFile(pa.BufferReader(data))
        names = [name for name in file.schema_arrow.names if not pa.types.is_nested(file.schema_arrow.field(name).type)]
        batch = next(file.iter_batches(batch_size=most, columns=names), None)
    except (pa.ArrowException, OSError) as error:
        raise TelemetryFormatError(f"the Parquet file is cut short or corrupt: {str(error)[:120]}") from error
    rows = [] if batch is None else [[_text(row[name]) for name in names] for row in batch.to_pylist()]
    return names, rows


def _text(value: object) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else str(value) if not isinstance(value, dict | list) else json.dumps(value)
