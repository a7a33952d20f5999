"""The formats of tables: a format is one file with its `TableCode`, and one entry in `FORMATS`.

What is known of a format stands here; its file is loaded when a table is read or written in it. Options, schemas,
content types, endings of files and the lists of the documentation are derived from this registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import PurePath
from typing import TYPE_CHECKING, Final

from magcal_core.telemetry.table_format import Reader, TableCode, TableFormat, opens_columns

if TYPE_CHECKING:
    import pyarrow as pa


def _csv() -> TableCode:
    from magcal_core.telemetry.csv_table import CODE

    return CODE


def _ndjson() -> TableCode:
    from magcal_core.telemetry.ndjson import CODE

    return CODE


def _json_columns() -> TableCode:
    from magcal_core.telemetry.json_columns import CODE

    return CODE


def _parquet() -> TableCode:
    from magcal_core.telemetry.parquet import CODE

    return CODE


FORMATS: Final[Mapping[str, TableFormat]] = {
    "csv": TableFormat(
        _csv,
        media_types=("text/csv", "text/tab-separated-values", "application/csv"),
        suffixes=(".csv", ".tsv", ".txt"),
    ),
    "ndjson": TableFormat(
        _ndjson,
        media_types=("application/x-ndjson", "application/ndjson", "application/jsonl"),
        suffixes=(".ndjson", ".jsonl"),
        looks_like=lambda head: head.startswith(b"{") and not opens_columns(head),
    ),
    "json": TableFormat(
        _json_columns,
        media_types=("application/json",),
        suffixes=(".json",),
        looks_like=lambda head: head.startswith(b"[") or opens_columns(head),
    ),
    "parquet": TableFormat(
        _parquet,
        media_types=("application/vnd.apache.parquet", "application/x-parquet"),
        suffixes=(".parquet", ".pq"),
        signature=b"PAR1",
    ),
}
"""Name -> format; a body that looks like no other is taken for the first."""
READERS: Final[Mapping[str, Reader]] = {name: one.read for name, one in FORMATS.items() if one.is_read}
WRITERS: Final[Mapping[str, Callable[[pa.Table], bytes]]] = {
    name: one.write for name, one in FORMATS.items() if one.is_written
}
MEDIA_TYPES: Final[Mapping[str, str]] = {
    media_type: name for name, one in FORMATS.items() for media_type in one.media_types_of(name)
}
"""Content type -> format; the first one of a format is what magcal itself answers with."""
SUFFIXES: Final[Mapping[str, str]] = {suffix: name for name, one in FORMATS.items() for suffix in one.suffixes_of(name)}
"""Ending of a file name -> format."""

_COMPRESSED: Final = frozenset({".gz", ".zst", ".zstd"})


def format_of_name(name: str | PurePath) -> str | None:
    """Return the format that a file's name has, endings of compression aside; None where it has none."""
    suffixes = [suffix.lower() for suffix in PurePath(name).suffixes if suffix.lower() not in _COMPRESSED]
    return SUFFIXES.get(suffixes[-1]) if suffixes else None


def media_type_of(name: str) -> str:
    """Return the content type of a format that magcal itself answers and sends it with."""
    return next(media_type for media_type, known in MEDIA_TYPES.items() if known == name)


def format_of_bytes(data: bytes) -> str:
    """Return the format that a body begins like."""
    for name in READERS:
        if FORMATS[name].has_signature(data):
            return name
    head = data[: 1 << 16].removeprefix(b"\xef\xbb\xbf").lstrip()
    return next((name for name in READERS if FORMATS[name].looks_like(head)), next(iter(READERS)))


def suffixes_of(names: Mapping[str, object]) -> str:
    """Return the first ending of each of the formats ``names``, as messages list them: ``.csv, .json or .parquet``."""
    firsts = [next(suffix for suffix, of in SUFFIXES.items() if of == name) for name in names]
    return firsts[0] if len(firsts) == 1 else f"{', '.join(firsts[:-1])} or {firsts[-1]}"
