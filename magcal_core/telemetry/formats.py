"""The formats of tables: a format is one file with a `TableFormat`, and one line in `FORMATS`.

Options, schemas, content types, endings of files and the lists of the documentation are derived from this registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import PurePath
from typing import Final

import pyarrow as pa

from magcal_core.telemetry import csv_table, json_columns, ndjson, parquet
from magcal_core.telemetry.table import Reader, TableFormat

FORMATS: Final[Mapping[str, TableFormat]] = {
    "csv": csv_table.FORMAT,
    "ndjson": ndjson.FORMAT,
    "json": json_columns.FORMAT,
    "parquet": parquet.FORMAT,
}
"""Name -> format; a body that looks like no other is taken for the first."""
READERS: Final[Mapping[str, Reader]] = {name: one.read for name, one in FORMATS.items() if one.read is not None}
WRITERS: Final[Mapping[str, Callable[[pa.Table], bytes]]] = {
    name: one.write for name, one in FORMATS.items() if one.write is not None
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
