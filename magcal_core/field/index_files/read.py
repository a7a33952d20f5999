"""Bytes in, an index out: compression, byte order mark, and which format the content is."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO, Final

from magcal_core.errors import EncodingError, IndexFormatError, TelemetryFormatError
from magcal_core.field.index import Index
from magcal_core.field.index_files import csv_index, dtu_rc, gfz_kp, hdf5, wdc_dst
from magcal_core.field.index_files.rows import data_lines, number_of
from magcal_core.telemetry.compression import decompress
from magcal_core.telemetry.text import checked_text

READERS: Final[Mapping[str, Callable[[str, str], Index]]] = {
    "wdc-dst": wdc_dst.read,
    "gfz-kp": gfz_kp.read,
    "dtu-rc": dtu_rc.read,
    "csv": csv_index.read,
}
"""Format -> what reads its text, with the SHA-256 of the file beside it; `hdf5` alone is not a text."""
FORMATS: Final = (*READERS, "hdf5")
_MOST_BYTES: Final = 256 << 20


def read_index(source: str | Path | bytes | BinaryIO) -> Index:
    """Return the index in a file: a path, its bytes, or an open binary file; plain, gzip or zstd.

    The content tells the format: `FORMATS`.

    Raises
    ------
    IndexFormatError
        It is no index file, or one with faults: the first hundred are listed with line and reason.
    TimeZoneMissingError
        A time in it has no zone.
    """
    content = bytes_of(source)
    sha256 = hashlib.sha256(content).hexdigest()
    try:
        plain = decompress(content, max_bytes=_MOST_BYTES)
        if plain.startswith(hdf5.MAGIC):
            return hdf5.read(plain, sha256)
        text = checked_text(plain).decode("utf-8")
    except (TelemetryFormatError, EncodingError) as error:
        raise IndexFormatError(f"not an index file: {error.message}") from error
    return READERS[format_of(text)](text, sha256)


def bytes_of(source: str | Path | bytes | BinaryIO) -> bytes:
    """Return the bytes of a path, of themselves, or of an open binary file."""
    if isinstance(source, (bytes, bytearray, memoryview)):
        return bytes(source)
    return Path(source).read_bytes() if isinstance(source, (str, Path)) else source.read()


def format_of(text: str) -> str:
    """Return the format that the content of an index file tells.

    Raises
    ------
    IndexFormatError
        It is none of them.
    """
    if any(map(wdc_dst.is_record, text.splitlines())):
        return "wdc-dst"
    lines = data_lines(text)
    first = lines[0][1] if lines else ""
    cells = first.split()
    if csv_index.is_header(first):
        return "csv"
    if len(cells) > 1 and len(cells[0]) == 4 and cells[0].isdigit():
        return "gfz-kp"
    if len(cells) > 1 and number_of(cells[0]) is not None and number_of(cells[1]) is not None:
        return "dtu-rc"
    raise IndexFormatError(f"no record of an index; known formats are {', '.join(FORMATS)}")
