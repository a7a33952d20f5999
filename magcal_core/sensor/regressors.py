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
    "the parameter set drifts with time and does not say since when: calibrate anew to have one that does"
)


def source_of(name: str) -> str:
    """Return the name of the column that the regressor ``name`` is made of."""
    return name.removesuffix(OF_SCALE)


def is_of_scale(name: str) -> bool:
    """Whether the regressor ``name`` moves the scale."""
    return name.endswith(OF_SCALE)


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
    return [source for source in dict.fromkeys(map(source_of, names)) if source not in columns]


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


def regressor_of(name: str, column: Floats, h_nt: Floats) -> Floats:
    """Return the regressor ``name`` from its column, shape (n,): itself, or times the reading, shape (n, 3), nT."""
    return column[:, None] * h_nt if is_of_scale(name) else column


def term_nt(regressor: Floats, coefficients: Floats) -> Floats:
    """Return what a regressor, shape (n,) or (n, 3), takes off the reading, shape (n, 3), nT."""
    return (regressor if regressor.ndim == 2 else regressor[:, None]) * coefficients
