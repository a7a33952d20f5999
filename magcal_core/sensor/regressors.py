"""Regressors by name: columns that move the bias, and columns times the reading, which move the scale.

``temperature`` adds its coefficient, nT per unit, to the bias of each axis. ``temperature*h`` multiplies the reading: a
share of it that is the coefficient times the column is taken off, axis by axis, which is a scale factor that changes
with the column. Both are terms that are subtracted from the raw reading h. ``before:TIME`` is a column that telemetry
need not have: 1 before the time, 0 after it, which is a step of the bias.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.errors import OptionError

TIME_REGRESSOR: Final = "time"
"""Name of the regressor that is no column: hours since the time base of the parameters, their first used sample."""
OF_SCALE: Final = "*h"
"""Ending of a regressor that moves the scale."""
BEFORE: Final = "before:"
"""Beginning of a regressor that is a step of the bias; the time of the step follows, ISO 8601 with Z."""


NO_TIME_BASE: Final = (
    "the parameter set drifts with time and does not say since when: calibrate again to have one that does"
)


LAG: Final = "@"
"""Stands before the number of samples by which the reading follows a column."""
RESPONSE_UNIT_NT: Final = 50_000.0
"""Reading that a response of the sensor is measured in: its coefficient is what it adds there, nT."""
_POWERS: Final = {"h^2": 2, "h^3": 3}
_RATE: Final = "dh/dt"
RESPONSES: Final = (*_POWERS, _RATE)
"""Terms that are made of the reading itself: its powers, nT, and its derivative (eddy currents), s."""
_GAP: Final = 1.5


def lag_of(name: str) -> tuple[str, int]:
    """Return the regressor ``name`` without its lag, and the lag in samples."""
    source, mark, lag = name.rpartition(LAG)
    is_lag = bool(mark) and lag.lstrip("+-").isdigit()
    return (source, int(lag)) if is_lag else (name, 0)


def lagged_name(source: str, lag: int) -> str:
    """Return the name of a column that the reading follows by ``lag`` samples."""
    return f"{source}{LAG}{lag}" if lag else source


def lagged(column: Floats, lag: int, t_s: Floats) -> Floats:
    """Return ``column``, shape (n,), ``lag`` samples before each one; NaN at the ends and across gaps of ``t_s``, s."""
    if lag == 0:
        return column
    n, found = len(column), np.full(len(column), np.nan)
    here = np.arange(max(lag, 0), min(n, n + lag))
    there = here - lag
    usual = float(np.median(np.diff(t_s))) if n > 1 else 0.0
    is_near = np.abs(np.abs(t_s[here] - t_s[there]) - abs(lag) * usual) <= (_GAP - 1.0) * usual
    found[here[is_near]] = column[there[is_near]]
    return found


def is_response(name: str) -> bool:
    """Whether the regressor ``name`` is made of the reading itself."""
    return name in RESPONSES


def response_of(name: str, h_nt: Floats, t_s: Floats) -> Floats:
    """Return a response of the sensor, shape (n, 3): (h / 50 uT)^m, or dh/dt, nT/s, by central differences."""
    if name in _POWERS:
        return np.asarray((h_nt / RESPONSE_UNIT_NT) ** _POWERS[name])
    found = np.zeros_like(h_nt)
    if len(t_s) < 3:
        return found
    steps = np.diff(t_s)
    usual = float(np.median(steps))
    is_near = (steps <= _GAP * usual) & (steps > 0)
    slopes = np.where(is_near[:, None], np.diff(h_nt, axis=0) / np.where(steps > 0, steps, 1.0)[:, None], 0.0)
    # At an edge or a gap the one side that there is.
    count = np.zeros(len(t_s))
    count[1:] += is_near
    count[:-1] += is_near
    found[1:] += slopes
    found[:-1] += slopes
    return np.asarray(found / np.maximum(count, 1.0)[:, None])


def source_of(name: str) -> str:
    """Return the name of the column that the regressor ``name`` is made of; its own name where that is the reading."""
    return lag_of(name.removesuffix(OF_SCALE))[0]


def is_of_scale(name: str) -> bool:
    """Whether the regressor ``name`` has a coefficient for each axis alone: it moves the scale, or is a response."""
    return name.endswith(OF_SCALE) or is_response(name)


def is_step(name: str) -> bool:
    """Whether the regressor ``name`` is a step of the bias."""
    return name.startswith(BEFORE)


def step_column(name: str, t_utc: Times) -> Floats:
    """Return the regressor ``before:TIME`` at times, shape (n,): 1 before its time, 0 from it on.

    Raises
    ------
    OptionError
        What follows ``before:`` is no time in UTC.
    """
    text = source_of(name).removeprefix(BEFORE)
    try:
        time = np.datetime64(text.removesuffix("Z"), "ns")
    except ValueError as error:
        raise OptionError(f"regressor {name!r}: want before:TIME, the time in ISO 8601 with Z") from error
    if not text.endswith("Z") or np.isnat(time):
        raise OptionError(f"regressor {name!r}: want before:TIME, the time in ISO 8601 with Z")
    return (t_utc < time).astype(np.float64)


def with_steps(names: Iterable[str], columns: Mapping[str, Floats], t_utc: Times) -> dict[str, Floats]:
    """Return ``columns`` with those of the steps among the regressors ``names``."""
    steps = {source_of(name): step_column(name, t_utc) for name in names if is_step(name)}
    return {**columns, **steps}


def missing_columns(names: Iterable[str], columns: Mapping[str, Floats]) -> list[str]:
    """Return the columns that regressors need and ``columns`` lacks."""
    sources = dict.fromkeys(source_of(name) for name in names if not is_response(name))
    return [source for source in sources if source not in columns]


def hours_since(t_utc: np.datetime64, base_utc: np.datetime64) -> float:
    """Return how many hours ``t_utc`` is after ``base_utc``."""
    return float((t_utc - base_utc) / np.timedelta64(1, "ns")) * 1e-9 / 3600.0


def with_time(columns: Mapping[str, Floats], t_utc: Times, base_utc: np.datetime64 | None) -> dict[str, Floats]:
    """Return ``columns`` with the hours since ``base_utc`` under the name of the regressor ``time``.

    As they are where there is no base, and where they have a column of that name.
    """
    if base_utc is None or TIME_REGRESSOR in columns:
        return dict(columns)
    return {**columns, TIME_REGRESSOR: (t_utc - base_utc) / np.timedelta64(1, "ns") * 1e-9 / 3600.0}


def regressor_of(name: str, columns: Mapping[str, Floats], h_nt: Floats, t_s: Floats) -> Floats:
    """Return the regressor ``name``: its column at its lag, shape (n,), or a term of each axis, shape (n, 3).

    ``columns``: name -> shape (n,); ``h_nt``: readings, shape (n, 3), nT; ``t_s``: times, shape (n,), s, ascending.
    """
    if is_response(name):
        return response_of(name, h_nt, t_s)
    column = lagged(np.asarray(columns[source_of(name)], np.float64), lag_of(name.removesuffix(OF_SCALE))[1], t_s)
    return column[:, None] * h_nt if is_of_scale(name) else column


def term_nt(regressor: Floats, coefficients: Floats) -> Floats:
    """Return what a regressor, shape (n,) or (n, 3), takes off the reading, shape (n, 3), nT."""
    return (regressor if regressor.ndim == 2 else regressor[:, None]) * coefficients
