"""Probabilities beyond a limit, by closed forms: `scipy.special` takes a tenth of a second to import."""

from __future__ import annotations

import math

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel


def normal_two_sided(sigmas: float) -> float:
    """Return the probability that a standard normal variable is further from zero than ``sigmas``."""
    return math.erfc(abs(sigmas) / math.sqrt(2.0))


def chi_square_of_three(statistic: float) -> float:
    """Return the probability that chi square of three degrees of freedom is above ``statistic``, not negative.

    Notes
    -----
    Q(3/2, x/2) = erfc(sqrt(x/2)) + sqrt(2 x / pi) exp(-x/2).
    """
    half = 0.5 * statistic
    return math.erfc(math.sqrt(half)) + 2.0 * math.sqrt(half / math.pi) * math.exp(-half)


@kernel(error_model="numpy")
def deviations_of_mixtures(weights: Floats, deviations: Floats, halvings: int) -> Floats:  # pragma: no cover - compiled
    """Return s, shape (p,), such that 1.96 s hold 95 % of each mixture of normal laws about zero.

    ``weights``, shape (g, p), sum to one over g; ``deviations``, shape (g, p), positive. The bracket of log s, between
    the least and the largest deviation, is halved ``halvings`` times; the rest is interpolated.
    """
    count, p = deviations.shape
    found = np.empty(p)
    for j in range(p):
        least, largest = deviations[0, j], deviations[0, j]
        for i in range(1, count):
            least, largest = min(least, deviations[i, j]), max(largest, deviations[i, j])
        low, high = math.log(least), math.log(largest)
        for _ in range(halvings):
            middle = 0.5 * (low + high)
            if _beyond(weights, deviations, j, middle) > 0.0:
                low = middle
            else:
                high = middle
        below = max(_beyond(weights, deviations, j, low), 0.0)
        above = min(_beyond(weights, deviations, j, high), 0.0)
        found[j] = math.exp(low + below / max(below - above, 1e-300) * (high - low))
    return found


@kernel(error_model="numpy")
def _beyond(weights: Floats, deviations: Floats, j: int, logarithm: float) -> float:  # pragma: no cover - compiled
    """Return what mixture ``j`` has below -1.96 exp(logarithm), less 2.5 %."""
    limit = 1.96 * math.exp(logarithm) / math.sqrt(2.0)
    total = 0.0
    for i in range(deviations.shape[0]):
        total += weights[i, j] * 0.5 * math.erfc(limit / deviations[i, j])
    return total - 0.025
