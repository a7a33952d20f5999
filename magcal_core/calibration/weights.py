"""Robust scale and robust weights: what iteratively reweighted least squares needs, for every estimator."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.kernels import LOSSES, TUNING, loss_terms

Floats = NDArray[np.float64]

GAUSSIAN_MAD: Final = 1.4826
"""Standard deviation of Gaussian noise over its median absolute deviation."""


def robust_sigma(residuals: Floats, floor: float = 0.0) -> float:
    """Return 1.4826 times the median of |``residuals``|, at least ``floor``, in the residuals' unit."""
    size = np.abs(residuals).ravel()
    low, high = (size.size - 1) // 2, size.size // 2
    # What `numpy.median` does, without what it does around it; the last place is where a NaN would be.
    size.partition((low, high, size.size - 1))
    middle = float("nan") if np.isnan(size[-1]) else 0.5 * float(size[low] + size[high])
    return max(GAUSSIAN_MAD * middle, floor)


def weights_and_slopes(residuals: Floats, robust: str, sigma: float) -> tuple[Floats, Floats]:
    """Return the weight psi(r)/r and the slope psi'(r) of each of ``residuals``, shape (n,), under a loss."""
    loss = LOSSES[robust]
    weight, slope = np.empty(residuals.size), np.empty(residuals.size)
    loss_terms(np.ascontiguousarray(residuals) / (TUNING[loss] * sigma), loss, weight, slope)
    return weight, slope


def shared_weight_slope(scaled: Floats, prior: Floats, weight: Floats, robust: str) -> float:
    """Return sum(w) over sum(psi') where the worst of a sample's three residuals decides the weight w of all three.

    Only the worst one's own slope is psi'; the other two are weighed by w, which does not depend on them. Of the three
    axes the one that loses most counts. ``scaled``: residuals over their deviations, shape (n, 3); ``prior``,
    ``weight``: prior weight and what the loss multiplies it by, shape (n,).
    """
    size = np.abs(scaled)
    worst = size.argmax(axis=1)
    slope = weights_and_slopes(np.take_along_axis(size, worst[:, None], axis=1)[:, 0], robust, 1.0)[1]
    kept = float(prior @ weight)
    lost = float(np.bincount(worst, prior * (weight - slope), 3).max())
    return kept / max(kept - lost, 0.05 * float(prior.sum()))
