"""How well a reference explains readings that may be bad in part, and what that says of a candidate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Mask
from magcal_core.calibration.estimators.loss import is_clean_within
from magcal_core.calibration.estimators.robust_start import Quadric, scale_of

EXPLAINED: Final = 0.02
"""Scale, as a share of |B|, below which a sensor explains the readings."""
INLIERS: Final = 0.55
"""Share of the rows that must lie within five scales."""
BETTER: Final = 1.3
"""Ratio of the capped residuals from which one reference is better than another."""
CAP: Final = 0.03
"""Share of |B| up to which a residual counts: rows that are left out weigh too, and none more than this."""
GAINS: Final = 8.0
"""Factor by which the gain of an axis may differ from one: beyond it a quadric is no sensor."""
COLOURED: Final = 0.4
"""Correlation of what neighbours leave from which on it is no noise."""
NOISE: Final = 0.2
"""Correlation up to which it is: of 100 pairs of noise, it is 0.1 by chance."""
WHOLE: Final = 0.005
"""Capped RMS, as a share of |B|, below which a coloured residual is what sensors leave."""
FAR_BETTER: Final = 3.5
"""Ratio of the capped residuals from which on a reference is better, coloured or not."""
MOST: Final = 0.9
"""Share of the rows within five scales that a right reference leaves where no rows are bad."""
_SUBSETS: Final = 60
_REACH: Final = 5.0
_RANK: Final = 1e-10
_FEW_PAIRS: Final = 30


@dataclass(frozen=True, slots=True)
class Explanation:
    """What the best sensor leaves under a reference.

    Attributes
    ----------
    scale, capped : robust scale and capped RMS, shares of |B|.
    inlier_share : share of the rows within five scales.
    is_sensor : whether what was found is one: of readings that say nothing, and a field that hardly varies, the
        quadric's constant explains all, with gains that are next to nothing.
    neighbours : correlation of what inliers leave with what the next ones do: a wrong reference that comes near leaves
        a smooth difference, the right one noise. NaN where too few have one.
    """

    scale: float
    capped: float
    inlier_share: float
    is_sensor: bool = True
    neighbours: float = 0.0

    @property
    def is_sound(self) -> bool:
        """Whether a sensor explains the readings."""
        return self.is_sensor and self.scale < EXPLAINED and self.inlier_share >= INLIERS

    @property
    def is_coloured(self) -> bool:
        """Whether what is left is smooth."""
        return self.neighbours > COLOURED

    @property
    def is_settled(self) -> bool:
        """Whether a sensor explains the readings and leaves noise: no other clock or orbit is worth a look."""
        return self.is_sound and abs(self.neighbours) <= NOISE

    def explains(self, given: Explanation) -> bool:
        """Whether this reference explains what the ``given`` one does not.

        What leaves a smooth difference of more than sensors do, or of only some of the rows, must be far better: of
        short sessions another hour's field comes near.
        """
        is_partial = self.inlier_share < MOST and self.neighbours > NOISE
        is_near = is_partial or (self.is_coloured and self.capped > WHOLE)
        return self.is_sound and self.capped <= given.capped / (FAR_BETTER if is_near else BETTER)


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
        """Return how well the field ``b_nt``, shape (m,), nT, explains the rows.

        By least squares where these leave no far row, else by least trimmed squares: of few rows half are always near.
        """
        r, scale_nt, unknowns = _plain(self.quadric, b_nt)
        if not is_clean_within(r, scale_nt, float(np.median(b_nt))):
            r, scale_nt, unknowns = self.quadric.fit_residuals_nt(b_nt)
        if not np.isfinite(scale_nt):
            return Explanation(np.inf, CAP, 0.0)
        size, field_nt = np.abs(r), float(np.median(b_nt))
        capped = float(np.sqrt(np.mean(np.minimum(size, CAP * field_nt) ** 2)))
        near = size <= _REACH * max(scale_nt, 1e-9 * field_nt)
        share = float(np.mean(near))
        return Explanation(scale_nt / field_nt, capped / field_nt, share, _is_sensor(unknowns), _neighbours(r, near))


def _plain(quadric: Quadric, b_nt: Floats) -> tuple[Floats, float, Floats]:
    """Return the residuals, shape (n,), nT, about least squares of all rows, their scale, nT, and the ten unknowns."""
    rows = quadric.squares / (2.0 * b_nt / quadric.unit_nt)[:, None]
    target = 0.5 * b_nt / quadric.unit_nt
    unknowns = np.asarray(np.linalg.lstsq(rows, target, rcond=_RANK)[0], np.float64)
    r = (rows @ unknowns - target) * quadric.unit_nt
    return r, scale_of(r), unknowns


def _is_sensor(unknowns: Floats) -> bool:
    """Return whether a quadric, of readings over their median size, is an ellipsoid with gains within `GAINS`."""
    a11, a22, a33, a12, a13, a23 = unknowns[:6]
    squares = np.linalg.eigvalsh(np.array([[a11, a12, a13], [a12, a22, a23], [a13, a23, a33]]))
    return bool(squares[0] > GAINS**-2 and squares[-1] < GAINS**2)


def _neighbours(residuals_nt: Floats, near: Mask) -> float:
    """Return the correlation of residuals, shape (n,), with the next ones, of the rows ``near``; NaN of too few."""
    pairs = near[1:] & near[:-1]
    if np.count_nonzero(pairs) < _FEW_PAIRS:
        return float("nan")
    r = residuals_nt - np.mean(residuals_nt[near])
    square = float(np.mean(r[near] ** 2))
    return float(np.mean(r[1:][pairs] * r[:-1][pairs])) / square if square > 0 else 0.0


def spread_of(column: Floats) -> float:
    """Return the spread of a column, in its unit: 1.4826 times the median distance from its median."""
    return 1.4826 * float(np.median(np.abs(column - np.median(column))))
