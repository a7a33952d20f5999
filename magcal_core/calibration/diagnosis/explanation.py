"""How well a reference explains readings that may be bad in part, and what that says of a candidate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.robust_start import Quadric

EXPLAINED: Final = 0.02
"""Scale, as a share of |B|, below which a sensor explains the readings."""
INLIERS: Final = 0.55
"""Share of the rows that must lie within five scales."""
BETTER: Final = 1.3
"""Ratio of the capped residuals from which one reference is better than another."""
CAP: Final = 0.03
"""Share of |B| up to which a residual counts: rows that are left out weigh too, and none more than this."""
_SUBSETS: Final = 60
_REACH: Final = 5.0
_ROUNDS: Final = 3


@dataclass(frozen=True, slots=True)
class Explanation:
    """What the best sensor leaves under a reference: scale and capped RMS, shares of |B|, and the share of inliers."""

    scale: float
    capped: float
    inlier_share: float

    @property
    def is_sound(self) -> bool:
        """Whether a sensor explains the readings."""
        return self.scale < EXPLAINED and self.inlier_share >= INLIERS

    def explains(self, given: Explanation) -> bool:
        """Whether this reference explains what the ``given`` one does not."""
        return self.is_sound and self.capped <= given.capped / BETTER


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The rows that a diagnosis looks at: readings, shape (m, 3), nT, ready to be fitted under many references."""

    h_nt: Floats
    quadric: Quadric

    @classmethod
    def of(cls, h_nt: Floats) -> Rows:
        """Return the rows of readings ``h_nt``."""
        own = np.ascontiguousarray(h_nt)
        return cls(own, Quadric.of(own, _SUBSETS))

    def explanation(self, b_nt: Floats) -> Explanation:
        """Return how well the field ``b_nt``, shape (m,), nT, explains the rows: by least trimmed squares."""
        r, scale_nt = self.quadric.fit_residuals_nt(b_nt)
        if not np.isfinite(scale_nt):
            return Explanation(np.inf, CAP, 0.0)
        size, field_nt = np.abs(r), float(np.median(b_nt))
        capped = float(np.sqrt(np.mean(np.minimum(size, CAP * field_nt) ** 2)))
        near = float(np.mean(size <= _REACH * max(scale_nt, 1e-9 * field_nt)))
        return Explanation(scale_nt / field_nt, capped / field_nt, near)

    def scores(self, fields_nt: Floats) -> Floats:
        """Return the median residual, a share of |B|, that each of many references leaves, shape (c,).

        ``fields_nt``: |B| of each, shape (c, m), nT.

        Notes
        -----
        All ten unknowns of the quadric at once for every reference, three rounds reweighted with 1 / (1 + (r/s)^2):
        cheap, and wrong rows lose their weight where the reference is right.
        """
        rows = self.quadric.squares
        products = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
        b = fields_nt / self.quadric.unit_nt
        base = 1.0 / (2.0 * b) ** 2
        weights, residual = base.copy(), np.empty_like(b)
        size = rows.shape[1]
        ridge = 1e-10 * np.eye(size)
        for _ in range(_ROUNDS):
            normals = (weights @ products).reshape(-1, size, size)
            scale = np.sqrt(np.einsum("cii->ci", normals))
            scaled = normals / (scale[:, :, None] * scale[:, None, :]) + ridge
            right = ((weights * b * b) @ rows) / scale
            found = np.linalg.solve(scaled, right[:, :, None])[:, :, 0] / scale
            residual = np.abs(found @ rows.T - b * b) / (2.0 * b)
            middle = np.maximum(np.median(residual, axis=1), 1e-12)
            weights = base / (1.0 + (residual / (1.4826 * middle[:, None])) ** 2)
        return np.asarray(np.median(residual, axis=1) / np.median(b, axis=1))


def spread_of(column: Floats) -> float:
    """Return the spread of a column, in its unit: 1.4826 times the median distance from its median."""
    return 1.4826 * float(np.median(np.abs(column - np.median(column))))
