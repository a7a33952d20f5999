"""Sums of a fit's equations over blocks of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats


@dataclass(frozen=True, slots=True, eq=False)
class BlockSums:
    """Sums over blocks, in the fit's own unknowns q: normals (m, q, q), scores (m, q), costs (m,), nT^2, weights (m,).

    The scores are those of the residual's derivative: half the gradient of the cost.
    """

    normals: Floats
    scores: Floats
    costs: Floats
    weights: Floats

    def moved(self, step: Floats) -> BlockSums:
        """Return the sums after the unknowns have moved by ``step``, shape (q,)."""
        along = self.normals @ step
        costs = self.costs + 2.0 * self.scores @ step + along @ step
        return replace(self, scores=self.scores + along, costs=np.maximum(costs, 0.0))

    def together(self, firsts: NDArray[np.intp]) -> BlockSums:
        """Return the sums of neighbours, which begin at the blocks ``firsts``."""
        return BlockSums(
            np.add.reduceat(self.normals, firsts, axis=0),
            np.add.reduceat(self.scores, firsts, axis=0),
            np.add.reduceat(self.costs, firsts),
            np.add.reduceat(self.weights, firsts),
        )

    def weighed(self, shares: Floats) -> BlockSums:
        """Return the sums with each block counted ``shares``, shape (m,), times."""
        by_row = shares[:, None]
        return BlockSums(
            self.normals * by_row[:, :, None], self.scores * by_row, self.costs * shares, self.weights * shares
        )
