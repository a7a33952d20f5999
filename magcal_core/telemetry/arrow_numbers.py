"""Numbers out of Arrow's buffers; Arrow's own conversion would load pandas, at half a second."""

from __future__ import annotations

from typing import Final, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.generic)
Kind = TypeVar("Kind", bound=np.generic)

_NUMPY_NAMES: Final = {"double": "float64", "float": "float32", "halffloat": "float16"}


def is_numeric(kind: pa.DataType) -> bool:
    """Return whether a column of this kind holds numbers."""
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def is_text(kind: pa.DataType) -> bool:
    """Return whether a column of this kind holds text."""
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def floats_of(column: pa.ChunkedArray) -> NDArray[np.float64]:
    """Return a numeric column, shape (n,), NaN where a cell is empty; doubles in one piece are shared, not copied."""
    kind = column.type
    if pa.types.is_float64(kind) and column.num_chunks == 1 and len(column) and not column.null_count:
        (cells,) = column.chunks
        return np.frombuffer(cells.buffers()[1], np.float64, len(cells), 8 * cells.offset)
    if pa.types.is_decimal(kind):
        return unpacked(column.cast(pa.float64()), np.dtype(np.float64), np.nan, np.dtype(np.float64))
    if pa.types.is_null(kind):
        return np.full(len(column), np.nan)
    sent = np.dtype(_NUMPY_NAMES.get(str(kind), str(kind)))
    return unpacked(column, sent, np.nan, np.dtype(np.float64))


def integers_of(column: pa.ChunkedArray, missing: int) -> NDArray[np.int64]:
    """Return a column of integers, shape (n,), with ``missing`` where a cell is empty."""
    return unpacked(column, np.dtype(str(column.type)), missing, np.dtype(np.int64))


def unpacked(column: pa.ChunkedArray, sent: np.dtype[Number], missing: float, wanted: np.dtype[Kind]) -> NDArray[Kind]:
    """Return the cells of a column from its buffers, shape (n,), with ``missing`` where one is empty."""
    values = np.empty(len(column), wanted)
    at = 0
    for chunk in column.chunks:
        part = values[at : at + len(chunk)]
        validity, cells = chunk.buffers()
        if len(chunk):
            part[:] = np.frombuffer(cells, sent, len(chunk), chunk.offset * sent.itemsize)
        if chunk.null_count:
            bits = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")
            part[bits[chunk.offset : chunk.offset + len(chunk)] == 0] = missing
        at += len(chunk)
    return values
