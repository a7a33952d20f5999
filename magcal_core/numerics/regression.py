"""Three weighted regressions on shared columns, plain or under a robust loss, over the compiled kernels."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.errors import NotObservableError
from magcal_core.numerics.regression_kernels import (
    regress,
    regress_affinely,
    regress_robustly,
    room_for,
    sums_of_blocks,
)
from magcal_core.numerics.robust import LOSSES

_ROUNDS: Final = 100
STILL: Final = 1e-9
"""Movement of a residual, in units of the noise, that ends the iteration."""


class Regression:
    """Targets i on the columns that are its own and a constant; it begins at zero and stays where it was left.

    Attributes
    ----------
    centre : shape (c,)
        Weighted mean of the columns, which the coefficients are about.
    coefficients : shape (3, c + 1)
        The last one is the constant.
    residuals : shape (3, n)
    total : moments of (columns - centre, 1, residuals) under the last weights, upper half.
    squares : shape (3,)
        Weighted sum of squares of the residuals.
    """

    __slots__ = ("_columns", "_largest", "_takes", "centre", "coefficients", "residuals", "squares", "total")

    def __init__(self, columns: Floats, targets: Floats, takes: NDArray[np.bool_], weights: Floats) -> None:
        """Prepare for ``columns``, shape (c, n), and ``targets``, shape (3, n); ``takes``: whose columns are whose."""
        c = len(columns)
        self._columns, self._takes = np.ascontiguousarray(columns), takes
        self.centre = self._columns @ weights / float(weights.sum())
        self.coefficients, self.residuals = np.zeros((3, c + 1)), np.array(targets, order="C")
        self._largest = np.maximum(self.residuals.max(axis=1), -self.residuals.min(axis=1))
        self.total, self.squares = np.empty((room_for(c), room_for(c))), np.empty(3)

    @property
    def smallest(self) -> Floats:
        """Smallest standard deviation of each target that its rounding allows, shape (3,)."""
        return np.asarray(np.maximum(1e-13 * self._largest, 1e-300))

    @property
    def _floor(self) -> float:
        return 1e-12 * float(self._largest.max())

    @property
    def _state(self) -> tuple[Floats, Floats, Floats, Floats]:
        return self.coefficients, self.residuals, self.total, self.squares

    def begin(self, slopes: Floats, constants: Floats) -> None:
        """Go from zero to known coefficients: ``slopes``, shape (3, c), and ``constants``, shape (3,), about zero."""
        self.coefficients[:, :-1], self.coefficients[:, -1] = slopes, constants + slopes @ self.centre
        self.residuals -= slopes @ self._columns
        self.residuals -= constants[:, None]

    def solve(self, weights: Floats) -> None:
        """Solve under fixed ``weights``, shape (n,).

        Raises
        ------
        NotObservableError
            A column is a combination of others and a constant.
        """
        if not regress(self._columns, self.centre, self._takes, weights, *self._state):
            raise _undetermined()

    def reweigh(self, prior: Floats, robust: str, still: float = STILL) -> tuple[Floats, int, bool]:
        """Solve under a loss of the worst residual, from where it is; return weights, rounds and whether they ended.

        ``still``: movement of a residual, in units of the noise, that ends it.

        Raises
        ------
        NotObservableError
            A column is a combination of others and a constant.
        """
        weights = np.empty_like(prior)
        shape = (self._columns, self.centre, self._takes, prior)
        least = (self._floor, self.smallest)
        rounds = regress_robustly(*shape, LOSSES[robust], *least, _ROUNDS, still, weights, *self._state)
        if rounds == 0:
            raise _undetermined()
        return weights, abs(int(rounds)), bool(rounds > 0)

    def reweigh_whole(self, prior: Floats, rounds: int) -> Floats:
        """Solve ``rounds`` times under Huber's loss of a sample's whole residual; return the weights it asks for.

        Raises
        ------
        NotObservableError
            A column is a combination of others and a constant.
        """
        weights = prior.copy()
        shape = (self._columns, self.centre, self._takes, prior)
        if not regress_affinely(*shape, self._floor, rounds, weights, *self._state):
            raise _undetermined()
        return weights

    def blocks(self, weights: Floats, starts: NDArray[np.intp]) -> Floats:
        """Return the moments of (columns, 1, residuals), not about the centre, of each block, shape (m, w, w)."""
        return block_sums(self._columns, self.residuals, weights, starts)


def block_sums(columns: Floats, residuals: Floats, weights: Floats, starts: NDArray[np.intp]) -> Floats:
    """Return the weighted moments of (columns, 1, residuals) of each block that begins at ``starts``, shape (m, w, w).

    ``columns``: shape (c, n); ``residuals``: shape (3, n), at c + 1 and on in the moments.
    """
    width = room_for(len(columns))
    totals = np.empty((len(starts), width, width))
    sums_of_blocks(columns, np.zeros(len(columns)), residuals, weights, starts, totals)
    return totals


def _undetermined() -> NotObservableError:
    return NotObservableError("the regressors cannot be told from one another or from the field", ["regressors"])
