"""Which unknowns a refit has, and what the files of its sums share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.linear_rows import Unknowns
from magcal_core.observations import Observations
from magcal_core.sensor.parameterisation import Standardised
from magcal_core.sensor.parameters import Parameters

_LOWER: Final = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))

Parts = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Which unknowns a refit has, and how much of each block of the sums it counts.

    Attributes
    ----------
    take : shape (p,)
        Places of the unknowns among all.
    columns : Standardised
        Regressors that the moments have; ``names``: those among the unknowns.
    has_clock : bool
    shares, weights : shape (m,)
        Share of each block of the moments' sums that is counted, and its weight.
    """

    take: NDArray[np.intp]
    columns: Standardised
    names: tuple[str, ...]
    has_clock: bool
    shares: Floats
    weights: Floats

    def shares_of(self, firsts: NDArray[np.intp]) -> Floats:
        """Return the share that is counted of groups of blocks, which begin at ``firsts``."""
        whole = np.add.reduceat(self.weights, firsts)
        return np.asarray(np.add.reduceat(self.weights * self.shares, firsts) / np.maximum(whole, 1e-300))

    def to_parameters(self, matrix: Floats, mean: Floats, spread: Floats) -> Floats:
        """Return the derivative of the reported parameters and the clock by the unknowns, shape (p, p)."""
        at = [self.columns.names.index(name) for name in self.names]
        drifts = Standardised(self.names, np.zeros((0, len(at))), mean[at], spread[at])
        return Unknowns(_LOWER, drifts, (), int(self.has_clock)).to_parameters(matrix)


def symmetric(upper: Floats, width: int) -> Floats:
    """Return matrices, shape (b, width, width), from their upper halves, shape (b, width (width + 1) / 2)."""
    at = np.triu_indices(width)
    full = np.empty((len(upper), width, width))
    full[:, at[0], at[1]] = upper
    full[:, at[1], at[0]] = upper
    return full


def with_slopes(parameters: Parameters, o: Observations) -> Parameters:
    """Return ``parameters`` with slopes of zero for the regressors of ``o`` that they lack, in the order of these."""
    none = np.zeros(3)
    return replace(parameters, regressors={name: parameters.regressors.get(name, none) for name in o.regressors})
