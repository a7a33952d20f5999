"""Cross-validation over contiguous blocks of time: what a calibration is worth on data that it has not seen."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations, residuals_nt
from magcal_core.errors import EstimationError

Floats = NDArray[np.float64]

FOLDS: Final = 6
"""Contiguous blocks of time, equally long, each left out in turn."""


def folds_of(t_s: Floats) -> list[NDArray[np.intp]]:
    """Return the samples of each block of time; blocks that a gap leaves empty are dropped."""
    span = max(float(t_s[-1] - t_s[0]), 1e-9)
    block = np.minimum((FOLDS * (t_s - t_s[0]) / span).astype(np.intp), FOLDS - 1)
    folds = [np.flatnonzero(block == k) for k in range(FOLDS)]
    return [fold for fold in folds if fold.size]


def held_out_residuals_nt(
    estimator: Estimator, observations: Observations, settings: FitSettings, near: Fit
) -> Floats | None:
    """Return the residual of every sample under the fit to the other blocks, shape (n,) or (n, 3), nT.

    ``near``: the fit to all data, from which the others start.

    None where the rest of the data does not determine the parameters once a block is left out.
    """
    parts = []
    for fold in folds_of(observations.t_s):
        # Zero weight equals absent: nothing is copied but the weights.
        weights = observations.weights.copy()
        weights[fold] = 0.0
        try:
            parameters = estimator.refit(replace(observations, weights=weights), settings, near)
        except EstimationError:
            return None
        parts.append(residuals_nt(observations.take(fold), parameters, estimator.is_vector))
    return np.concatenate(parts)


def rms_nt(residuals: Floats, weights: Floats) -> float:
    """Return the root mean square, over all components, of the residuals of samples that have weight."""
    used = residuals[weights > 0]
    return float(np.sqrt(np.mean(used**2)))
