"""Regressors by name: columns that move the bias, and columns times the reading, which move the scale.

``temperature`` adds its coefficient, nT per unit, to the bias of each axis. ``temperature*h`` multiplies the reading: a
share of it that is the coefficient times the column is taken off, axis by axis, which is a scale factor that changes
with the column. Both are terms that are subtracted from the raw reading h.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from magcal_core.arrays import Floats

TIME_REGRESSOR: Final = "time"
"""Name of the regressor that is no column: hours since the first sample."""
OF_SCALE: Final = "*h"
"""Ending of a regressor that moves the scale."""


def source_of(name: str) -> str:
    """Return the name of the column that the regressor ``name`` is made of."""
    return name.removesuffix(OF_SCALE)


def is_of_scale(name: str) -> bool:
    """Whether the regressor ``name`` moves the scale."""
    return name.endswith(OF_SCALE)


def missing_columns(names: Iterable[str], columns: Mapping[str, Floats]) -> list[str]:
    """Return the columns that regressors need and ``columns`` lacks."""
    return [source for source in dict.fromkeys(map(source_of, names)) if source not in columns]


def regressor_of(name: str, column: Floats, h_nt: Floats) -> Floats:
    """Return the regressor ``name`` from its column, shape (n,): itself, or times the reading, shape (n, 3), nT."""
    return column[:, None] * h_nt if is_of_scale(name) else column


def term_nt(regressor: Floats, coefficients: Floats) -> Floats:
    """Return what a regressor, shape (n,) or (n, 3), takes off the reading, shape (n, 3), nT."""
    return (regressor if regressor.ndim == 2 else regressor[:, None]) * coefficients
