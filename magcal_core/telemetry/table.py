"""What a reader hands over: the columns of one table under magcal's names, nothing judged yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.errors import TelemetryFormatError, TimeError, TimeZoneMissingError
from magcal_core.telemetry.columns import ColumnMap, ColumnPlan
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.times import NO_TIME, epoch_ns, parse_times

Number = TypeVar("Number", bound=np.generic)
Kind = TypeVar("Kind", bound=np.generic)

EMPTY_CELLS: Final = ("", "NA", "N/A", "null", "NULL", "None")
"""Texts that stand for an empty cell; ``nan`` and ``inf`` in any case are numbers that are not finite."""


@dataclass(frozen=True, slots=True, eq=False)
class RawTable:
    """Columns as they were sent.

    Attributes
    ----------
    t_ns : int64, shape (n,)
        Time, nanoseconds since the epoch of its scale; `NO_TIME` where the cell is empty.
    is_epoch : bool
        Whether times came as numbers rather than as ISO 8601.
    numbers : name -> float64, shape (n,)
        Standard columns under their standard names, the rest under their own; NaN where the cell is empty.
    ignored : names
        Columns that hold no numbers.
    """

    t_ns: Nanoseconds
    is_epoch: bool
    numbers: Mapping[str, Floats]
    ignored: tuple[str, ...]


class Reader(Protocol):
    """Reads one format."""

    def __call__(self, data: bytes, columns: ColumnMap | None, *, max_rows: int) -> RawTable:
        """Return the table in ``data``.

        Raises
        ------
        InputError
            With every fault of the table.
        """
        ...


def from_arrow(table: pa.Table, plan: ColumnPlan, *, name: str) -> RawTable:
    """Return an Arrow table, whose columns bear their own names, as a raw table.

    Raises
    ------
    InputError
        A needed column is not numeric, or a time cannot be read.
    """
    t_ns, is_epoch = arrow_times(table.column(plan.time), name=name)
    faults = FaultList(name)
    numbers: dict[str, Floats] = {}
    for own, standard in plan.numbers.items():
        column = table.column(own)
        if not _is_numeric(column.type) and column.null_count < len(column):
            faults.add(TelemetryFormatError, f"column {own}", f"holds {column.type}, want numbers")
        else:
            numbers[standard] = floats_of(column)
    faults.raise_if_any()
    ignored = []
    for own, keeping in plan.housekeeping.items():
        column = table.column(own)
        if _is_numeric(column.type) and column.null_count < len(column):
            numbers[keeping] = floats_of(column)
        else:
            ignored.append(own)
    return RawTable(t_ns, is_epoch, numbers, tuple(ignored))


def arrow_times(column: pa.ChunkedArray, *, name: str) -> tuple[Nanoseconds, bool]:
    """Return the nanoseconds of an Arrow column of times, and whether it held numbers.

    Raises
    ------
    TimeError, TimeZoneMissingError
        The column holds something else, times without a zone or beyond 1677 to 2262.
    """
    kind = column.type
    if pa.types.is_timestamp(kind):
        if kind.tz is None:
            raise TimeZoneMissingError(f"column time of the {name} holds timestamps without a zone; store them as UTC")
        try:
            instants = column if kind.unit == "ns" else column.cast(pa.timestamp("ns", kind.tz))
        except pa.ArrowInvalid as error:
            raise TimeError(f"column time of the {name} has times outside the years 1972 to 2099") from error
        whole = np.dtype(np.int64)
        return _unpacked(instants, whole, NO_TIME, whole), False
    if _is_numeric(kind):
        return epoch_ns(floats_of(column)), True
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        return _text_times(column, name=name)
    raise TimeError(f"column time of the {name} holds {kind}, want ISO 8601 with a zone, timestamps or seconds")


def _text_times(column: pa.ChunkedArray, *, name: str) -> tuple[Nanoseconds, bool]:
    try:
        return arrow_times(column.cast(pa.timestamp("ns", "UTC")), name=name)
    except pa.ArrowInvalid:
        # Arrow stops at the first fault and knows no leap seconds: read cell by cell.
        faults = FaultList(name)
        texts = column.to_pylist()
        cells = [(f"row {row + 1}, column time", text) for row, text in enumerate(texts)]
        t_ns = parse_times(cells, faults)
        faults.raise_if_any()
        return t_ns, False


def _is_numeric(kind: pa.DataType) -> bool:
    return bool(pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind))


def floats_of(column: pa.ChunkedArray) -> Floats:
    """Return a numeric column, shape (n,), NaN where a cell is empty; doubles in one piece are shared, not copied."""
    kind = column.type
    if pa.types.is_float64(kind) and column.num_chunks == 1 and len(column) and not column.null_count:
        (cells,) = column.chunks
        return np.frombuffer(cells.buffers()[1], np.float64, len(cells), 8 * cells.offset)
    if pa.types.is_decimal(kind):
        return _unpacked(column.cast(pa.float64()), np.dtype(np.float64), np.nan, np.dtype(np.float64))
    sent = np.dtype(_NUMPY_NAMES.get(str(kind), str(kind)))
    return _unpacked(column, sent, np.nan, np.dtype(np.float64))


_NUMPY_NAMES: Final = {"double": "float64", "float": "float32", "halffloat": "float16"}


def _unpacked(column: pa.ChunkedArray, sent: np.dtype[Number], missing: float, wanted: np.dtype[Kind]) -> NDArray[Kind]:
    """Return the cells of a column from its buffers; Arrow's own conversion would load pandas, at half a second."""
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
