"""Regressors by name: columns that move the bias, and columns times the reading, which move the scale.

``temperature`` adds its coefficient, nT per unit, to the bias of each axis. ``temperature*h`` multiplies the reading: a
share of it that is the coefficient times the column is taken off, axis by axis, which is a scale factor that changes
with the column. Both are terms that are subtracted from the raw reading h.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times

TIME_REGRESSOR: Final = "time"
"""Name of the regressor that is no column: hours since the time base of the parameters, their first used sample."""
OF_SCALE: Final = "*h"
"""Ending of a regressor that moves the scale."""


NO_TIME_BASE: Final = (
    "the parameter set drifts with time and does not say since when: calibrate anew to have one that does"
)


def source_of(name: str) -> str:
    """Return the name of the column that the regressor ``name`` is made of."""
    return name.removesuffix(OF_SCALE)


def is_of_scale(name: str) -> bool:
    """Whether the regressor ``name`` moves the scale."""
    return name.endswith(OF_SCALE)


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
