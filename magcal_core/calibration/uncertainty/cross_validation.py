"""Cross-validation over contiguous blocks of time: what a calibration is worth on data that it has not seen."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.uncertainty.reweighted_blocks import moves_of
from magcal_core.errors import EstimationError
from magcal_core.observations import Observations, residuals_nt

FOLDS: Final = 6
"""Contiguous blocks of time, equally long, each left out in turn."""
_MANY: Final = 500
"""Samples from which on a fit to the other blocks is first looked for one step away."""
_SAME: Final = 1e-3
"""Relative difference of a block's residual, after the step and after the refit, up to which they agree."""


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

    Notes
    -----
    But for short sessions, the fits to the other blocks are one step away. They are refitted to the samples, from the
    farthest one on, until one leaves its block the residual that the step left it. All are refitted where the fit has
    no covariance: how far a step is, in standard errors, is not known then.
    """
    folds = folds_of(observations.t_s)
    unseen = partial(_unseen_nt, estimator, observations, settings, near)
    try:
        if len(observations) < _MANY or not _has_errors(near):
            return np.concatenate([unseen(fold) for fold in folds])
        return np.concatenate(_stepped_nt(estimator, observations, near, folds, unseen))
    except EstimationError:
        return None


def _has_errors(near: Fit) -> bool:
    """Return whether every parameter has a variance; rounding leaves negative ones where the data determine nothing."""
    variances = np.diag(near.covariance)
    return bool(np.isfinite(variances).all() and (variances > 0.0).all())


def _unseen_nt(
    estimator: Estimator, observations: Observations, settings: FitSettings, near: Fit, fold: slice
) -> Floats:
    """Return the residuals of the samples ``fold``, nT, under the fit to the others."""
    # Zero weight equals absent: nothing is copied but the weights.
    weights = observations.weights.copy()
    weights[fold] = 0.0
    parameters = estimator.refit(replace(observations, weights=weights), settings, near)
    return residuals_nt(observations.take(fold), parameters, estimator.is_vector)


def _stepped_nt(
    estimator: Estimator,
    observations: Observations,
    near: Fit,
    folds: Sequence[slice],
    unseen: Callable[[slice], Floats],
) -> list[Floats]:
    """Return the residuals of each fold, nT, one step away from ``near``, or refitted where the step is too long."""
    at = replace(near.parameters, time_offset_s=None)
    left = 1.0 - _shares(near.blocks.starts, folds, len(observations))
    moves = moves_of(near, left, is_vector=estimator.is_vector)
    parts = [
        residuals_nt(observations.take(fold), at.with_vector(at.vector + move), estimator.is_vector)
        for fold, move in zip(folds, moves, strict=True)
    ]
    errors = np.sqrt(np.diag(near.covariance)[: at.vector.size])
    for i in np.argsort(-np.max(np.abs(moves) / errors, axis=1)).tolist():
        used, stepped = near.weights[folds[i]] > 0, parts[i]
        parts[i] = unseen(folds[i])
        size = float(np.linalg.norm(parts[i][used]))
        if abs(float(np.linalg.norm(stepped[used])) - size) <= _SAME * size:
            break
    return parts


def _shares(starts: NDArray[np.intp], folds: Sequence[slice], n: int) -> Floats:
    """Return the share of each block of the fit, by its first sample, that lies in each fold, shape (folds, blocks)."""
    edges = np.append(starts, n)
    inside = [np.minimum(edges[1:], fold.stop) - np.maximum(edges[:-1], fold.start) for fold in folds]
    return np.asarray(np.maximum(inside, 0) / np.diff(edges))


def rms_nt(residuals: Floats, weights: Floats) -> float:
    """Return the root mean square, over all components, of the residuals of samples that have weight."""
    used = weights > 0
    flat = (residuals if used.all() else residuals[used]).ravel()
    return float(np.sqrt(flat @ flat / flat.size))
