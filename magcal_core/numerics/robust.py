"""Robust scale and robust weights: what iteratively reweighted least squares needs, for every estimator."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel

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


LOSSES: Final[dict[str, int]] = {"none": 0, "huber": 1, "soft_l1": 2, "cauchy": 3, "tukey": 4}
"""Robust loss -> its number in the kernels."""


TUNING: Final[tuple[float, ...]] = (1.0, 1.345, 1.345, 2.3849, 4.6851)
"""Residual, in robust standard deviations, at which each loss bends: 95 % efficiency on Gaussian noise."""


@kernel(inline="always")
def loss_of(loss: int, s2: float) -> tuple[float, float]:  # pragma: no cover - compiled
    """Return rho(s^2), with rho ~ s^2 at zero, and the weight rho'(s^2)."""
    rho, weight = s2, 1.0
    if loss == 1 and s2 > 1.0:
        s = math.sqrt(s2)
        rho, weight = 2.0 * s - 1.0, 1.0 / s
    elif loss == 2:
        root = math.sqrt(1.0 + s2)
        rho, weight = 2.0 * (root - 1.0), 1.0 / root
    elif loss == 3:
        rho, weight = math.log1p(s2), 1.0 / (1.0 + s2)
    elif loss == 4:
        left = max(0.0, 1.0 - s2)
        rho, weight = (1.0 - left * left * left) / 3.0, left * left
    return rho, weight


@kernel(inline="always")
def slope_of(loss: int, s2: float) -> float:  # pragma: no cover - compiled
    """Return psi'(s), psi = rho'/2, of the residual whose square in units of the bend is ``s2``."""
    slope = 1.0
    if loss == 1:
        slope = 1.0 if s2 <= 1.0 else 0.0
    elif loss == 2:
        root = math.sqrt(1.0 + s2)
        slope = 1.0 / (root * root * root)
    elif loss == 3:
        slope = (1.0 - s2) / (1.0 + s2) ** 2
    elif loss == 4:
        slope = 0.0 if s2 >= 1.0 else (1.0 - s2) * (1.0 - 5.0 * s2)
    return slope


@kernel()
def loss_terms(scaled: Floats, loss: int, weight: Floats, slope: Floats) -> None:  # pragma: no cover - compiled
    """Leave weight and psi' of every residual in ``weight`` and ``slope``; ``scaled`` is in units of the bend."""
    for i in range(scaled.shape[0]):
        s2 = scaled[i] * scaled[i]
        weight[i] = loss_of(loss, s2)[1]
        slope[i] = slope_of(loss, s2)
