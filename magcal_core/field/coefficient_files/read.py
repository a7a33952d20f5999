"""Bytes in, coefficients out: compression, byte order mark, and which format the content is."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO, Final

from magcal_core.errors import EncodingError, FieldFileError, TelemetryFormatError
from magcal_core.field.coefficient_files import cof, shc
from magcal_core.field.coefficients import CoefficientFile
from magcal_core.field.index_files.read import bytes_of
from magcal_core.telemetry.compression import decompress
from magcal_core.telemetry.text import checked_text

READERS: Final[Mapping[str, Callable[[str, str | None, str], CoefficientFile]]] = {"shc": shc.read, "cof": cof.read}
"""Format -> what reads its text, with the file's name and its SHA-256 beside it."""
_MOST_BYTES: Final = 128 << 20


def read_field_file(source: str | Path | bytes | BinaryIO, name: str | None = None) -> CoefficientFile:
    """Return the coefficients in a file: a path, its bytes, or an open binary file; plain, gzip or zstd.

    ``name``: what the record calls it; that of the path unless given. The content tells the format, `READERS`.

    Raises
    ------
    FieldFileError
        It is no file of coefficients, or one with faults: the first hundred are listed with line and reason.
    """
    content = bytes_of(source)
    if name is None and isinstance(source, (str, Path)):
        name = Path(source).name
    try:
        text = checked_text(decompress(content, max_bytes=_MOST_BYTES)).decode("utf-8")
    except (TelemetryFormatError, EncodingError) as error:
        raise FieldFileError(f"not a file of coefficients: {error.message}") from error
    return READERS[format_of(text)](text, name, hashlib.sha256(content).hexdigest())


def format_of(text: str) -> str:
    """Return the format that the content of a file of coefficients tells.

    Raises
    ------
    FieldFileError
        It is none of them.
    """
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    first = next(lines, [])
    if shc.is_header(first):
        return "shc"
    if cof.is_header(first):
        return "cof"
    raise FieldFileError(f"no file of coefficients; known formats are {', '.join(READERS)}")
