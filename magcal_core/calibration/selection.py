"""Cross-validation over contiguous blocks of time: what a calibration is worth on data that it has not seen."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations, residuals_nt
from magcal_core.errors import EstimationError

Floats = NDArray[np.float64]

FOLDS: Final = 6
"""Contiguous blocks of time, equally long, each left out in turn."""


def folds_of(t_s: Floats) -> list[slice]:
    """Return the samples of each block of time, ``t_s`` ascending; blocks that a gap leaves empty are dropped."""
    first, span = float(t_s[0]), max(float(t_s[-1] - t_s[0]), 1e-9)

    def block(i: int) -> int:
        return min(int(FOLDS * (float(t_s[i]) - first) / span), FOLDS - 1)

    edges = [bisect_left(range(len(t_s)), k, key=block) for k in range(FOLDS)] + [len(t_s)]
    return [slice(i, j) for i, j in pairwise(edges) if i < j]


def held_out_residuals_nt(
    estimator: Estimator, observations: Observations, settings: FitSettings, near: Fit
) -> Floats | None:
    """Return the residual of every sample under the fit to the other blocks, shape (n,) or (n, 3), nT.

    ``near``: the fit to all data, from which the others start.

    None where the rest of the data does not determine the parameters once a block is left out.
    """
    # Zero weight equals absent: nothing is copied but the weights.
    weights, parts = observations.weights.copy(), []
    for fold in folds_of(observations.t_s):
        weights[fold] = 0.0
        try:
            parameters = estimator.refit(replace(observations, weights=weights), settings, near)
        except EstimationError:
            return None
        weights[fold] = observations.weights[fold]
        parts.append(residuals_nt(observations.take(fold), parameters, estimator.is_vector))
    return np.concatenate(parts)


def rms_nt(residuals: Floats, weights: Floats) -> float:
    """Return the root mean square, over all components, of the residuals of samples that have weight."""
    used = weights > 0
    flat = (residuals if used.all() else residuals[used]).ravel()
    return float(np.sqrt(flat @ flat / flat.size))
