"""What a reader hands over: the columns of one table under magcal's names, nothing judged yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.errors import TelemetryFormatError, TimeError, TimeZoneMissingError
from magcal_core.telemetry.arrow_numbers import floats_of, is_numeric, is_text, unpacked
from magcal_core.telemetry.columns import ColumnPlan
from magcal_core.telemetry.declared_times import declared_times
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.iso_times import NO_TIME, Spans
from magcal_core.telemetry.times import epoch_ns, parse_times

EMPTY_CELLS: Final = ("", "NA", "N/A", "n/a", "#N/A", "#N/A N/A", "#VALUE!", "-", "--", "null", "NULL", "None")
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
    scale : str, optional
        ``utc`` or ``gps`` where the form of the times tells their scale; times then count from 1970 on it.
    is_valid : bool, shape (n,), optional
        Whether the table says that a reading is good.
    bad_rows : int
        Rows that were left out because they are none: a header among them, a last one that is cut.
    """

    t_ns: Nanoseconds
    is_epoch: bool
    numbers: Mapping[str, Floats]
    ignored: tuple[str, ...]
    scale: str | None = None
    is_valid: NDArray[np.bool_] | None = None
    bad_rows: int = 0


def from_arrow(table: pa.Table, plan: ColumnPlan, *, name: str) -> RawTable:
    """Return an Arrow table, whose columns bear their own names, as a raw table.

    Raises
    ------
    InputError
        A needed column is not numeric, or a time cannot be read.
    """
    faults = FaultList(name)
    is_epoch, scale = False, None
    if plan.times.is_declared:
        parts = {part: table.column(own) for part, own in plan.times.own.items()}
        t_ns, scale = declared_times(plan.times, parts, lambda i: f"row {i + 1}, column {plan.time}", faults)
    else:
        t_ns, is_epoch = arrow_times(table.column(plan.time), name=name, spans=plan.times.form.spans)
    numbers: dict[str, Floats] = {}
    for own, standard in plan.numbers.items():
        column = table.column(own)
        if not is_numeric(column.type) and column.null_count < len(column):
            faults.add(TelemetryFormatError, f"column {own}", f"holds {column.type}, want numbers")
        else:
            numbers[standard] = floats_of(column)
    faults.raise_if_any()
    ignored = []
    for own, keeping in plan.housekeeping.items():
        column = table.column(own)
        if is_numeric(column.type) and column.null_count < len(column):
            numbers[keeping] = floats_of(column)
        else:
            ignored.append(own)
    validity = plan.validity
    good = None if validity is None else validity.is_good(table.column(validity.column).to_pylist())
    return RawTable(t_ns, is_epoch, numbers, tuple(ignored), scale, good)


def arrow_times(column: pa.ChunkedArray, *, name: str, spans: Spans = ()) -> tuple[Nanoseconds, bool]:
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
        return unpacked(instants, whole, NO_TIME, whole), False
    if is_numeric(kind):
        return epoch_ns(floats_of(column), spans), True
    if is_text(kind):
        return _text_times(column, name=name, spans=spans)
    raise TimeError(f"column time of the {name} holds {kind}, want ISO 8601 with a zone, timestamps or seconds")


def _text_times(column: pa.ChunkedArray, *, name: str, spans: Spans) -> tuple[Nanoseconds, bool]:
    try:
        return arrow_times(column.cast(pa.timestamp("ns", "UTC")), name=name)
    except pa.ArrowInvalid:
        # Arrow stops at the first fault and knows no leap seconds: read cell by cell.
        faults = FaultList(name)
        texts = column.to_pylist()
        cells = [(f"row {row + 1}, column time", text) for row, text in enumerate(texts)]
        t_ns = parse_times(cells, faults, spans)
        faults.raise_if_any()
        return t_ns, False
