"""Rows in the sun, or in shadow, of which a loss rejects many where it rejects hardly any of the others.

Notes
-----
A loss judges each row by itself, as if bad rows came one by one. Where panels carry current, or the satellite turns in
another mode, all rows of that light are of another bias: those that the loss keeps are the ones whose error happens to
be small at the estimate. They were chosen for agreeing with it, so they say nothing of how certain it is; but few rows
in other attitudes have much leverage. On a real satellite, sampled every 10 s in shadow and every few minutes in the
sun, the half of its sunlit rows that Tukey's loss kept (6 % of the rows) made the error of the bias along one axis
70 nT where rows in shadow have 300 to 1200 nT, and four quarters of a day differed by 1400 nT.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Mask

MANY: Final = 1.0 / 3.0
"""Least share of the rows of one light that the loss rejects."""
FEWER: Final = 0.25
"""Largest share of the rows of the other light that it rejects, over that share."""
CERTAIN: Final = 24.0
"""Likelihood ratio of two shares against one (twice its logarithm): 1e-6 by chance, rows rejected one by one."""
MINORITY: Final = 0.25
"""Largest share of all rows that are left out: of more, it is not them that are the exception."""


@dataclass(frozen=True, slots=True, eq=False)
class OddLight:
    """Rows of the light in which the loss rejects many.

    Attributes
    ----------
    rows : shape (n,)
        All rows of that light.
    is_sun : bool
        Whether they are those in the sun.
    rejected, count : int
        Those of them that the loss rejects, and all.
    others_rejected, others : int
        The same of the other rows.
    """

    rows: Mask
    is_sun: bool
    rejected: int
    count: int
    others_rejected: int
    others: int

    @property
    def warning(self) -> str:
        """What the record says of them."""
        here, there = ("the sun", "shadow") if self.is_sun else ("shadow", "the sun")
        return (
            f"odd_light: the loss rejects {self.rejected} of {self.count} rows in {here} and {self.others_rejected} of "
            f"{self.others} in {there}: all rows in {here} are left out, the bias is another one there; give the "
            "currents of the panels as regressors"
        )


def odd_light(weights: Floats, light: Floats) -> OddLight | None:
    """Return the rows of the light in which a loss rejects many, where it rejects hardly any in the other; else None.

    ``weights``, shape (n,): those that the loss gave; ``light``, shape (n,): 1 in the sun, 0 in the umbra.
    """
    rejected = weights <= 0.0
    for is_sun in (True, False):
        rows = (light > 0.0) == is_sun
        count, others = int(np.count_nonzero(rows)), int(np.count_nonzero(~rows))
        if not count or not others or count > MINORITY * len(rows):
            continue
        here, there = int(np.count_nonzero(rejected & rows)), int(np.count_nonzero(rejected & ~rows))
        is_many = here >= MANY * count and there / others <= FEWER * here / count
        if is_many and _likelihood_ratio(here, count, there, others) >= CERTAIN:
            return OddLight(rows, is_sun, here, count, there, others)
    return None


def _likelihood_ratio(first: int, of_first: int, second: int, of_second: int) -> float:
    """Return twice the logarithm of the likelihood of two shares over that of one."""

    def log_likelihood(found: int, count: int) -> float:
        part = np.array([found, count - found], np.float64)
        return float(np.sum(part[part > 0] * np.log(part[part > 0] / count)))

    together = log_likelihood(first + second, of_first + of_second)
    return 2.0 * (log_likelihood(first, of_first) + log_likelihood(second, of_second) - together)
