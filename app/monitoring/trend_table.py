"""The states of a trend as a table: one row a time, in flat numbers as the history has them."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from magcal_core.arrays import Times
from magcal_core.calibration.sessions.trend import Trend
from magcal_core.calibration.sessions.trend_states import TrendStates

GROUPS: Final = (("bias", "_nt"), ("scale", ""), ("angle", "_deg"))
POINTS: Final = 200
MOST_POINTS: Final = 5000


def evenly(begin: np.datetime64, end: np.datetime64, points: int) -> Times:
    """Return times, ns UTC, evenly spaced from ``begin`` to ``end``, both among them."""
    first, last = (int(time.astype("datetime64[ns]").astype(np.int64)) for time in (begin, end))
    if points == 1:
        return np.array([last], np.int64).astype("datetime64[ns]")
    return np.array([first + (last - first) * i // (points - 1) for i in range(points)], np.int64).astype(
        "datetime64[ns]"
    )


def series_of(trend: Trend, begin: np.datetime64 | None, end: np.datetime64 | None, points: int) -> TrendStates:
    """Return the states of a trend, from its first set to the time it is told for unless asked otherwise."""
    first = np.datetime64(trend.sets[0].time_ns, "ns")
    return trend.at(evenly(first if begin is None else begin, trend.at_utc if end is None else end, points))


def trend_table(states: TrendStates) -> pa.Table:
    """Return states as a table: time, nine values, nine errors, the bound of the field's error, nT."""
    columns: dict[str, pa.Array] = {"time": pa.array(states.t_utc).cast(pa.timestamp("ns", "UTC"))}
    for suffix, values in (("", states.parameters), ("_error", states.standard_errors)):
        for row, (group, unit) in enumerate(GROUPS):
            for i in range(3):
                columns[f"{group}_{i + 1}{suffix}{unit}"] = pa.array(np.ascontiguousarray(values[:, 3 * row + i]))
    columns["field_error_nt"] = pa.array(states.field_error_nt)
    return pa.table(columns)
