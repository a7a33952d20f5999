"""Variances of the parameters from the lowest frequencies of their scores: errors under a memory of any length.

Notes
-----
The error of an estimate is the sum of its scores, that is, their content at frequency zero, which the fit itself sets
to zero in the data. It has to be carried over from the lowest frequencies that remain. Blocks cannot do so where the
memory of the errors is a good part of the session: too few are independent. Here the scores' cosine transform c_k,
k = 1..K, in units of what white noise would give after the same fit, is set beside first-order processes of several
memories and sizes,

    c_k^2 ~ s^2 (1 + a d_k(tau)),    variance of the sum = s^2 (1 + a z(tau)),

with d_k and z of exp(-|t|/tau). The variance is the mean over all (tau, a), weighed by how well each explains the c_k;
white noise has three to one beforehand, every other one an equal share of the rest. So one long wave that shows widens
the interval, and so does, by less, the one that so short a session could not have shown.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import BlockScores, scaled_inverse

Floats = NDArray[np.float64]

MEMORIES: Final = (0.015, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)
"""Correlation times that are tried, as a share of the session."""
SIZES: Final = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Variances of the process that are tried, in units of that of a block's white noise."""
WHITE_ODDS: Final = 0.75
"""Probability, before the data are seen, that the scores are white."""
_BLOCKS: Final = 64
_FREQUENCIES: Final = 40
_LEAST_SHARE: Final = 0.1
"""Least share of a frequency's white noise that the fit is taken to leave: what it took up is not known better."""


def low_frequency_variances(scores: BlockScores) -> tuple[Floats, int]:
    """Return the variance of each reported parameter, shape (p,), and the number of frequencies it was taken from."""
    sums, normals = _merged(scores)
    m = len(sums)
    count = min(m - 1, _FREQUENCIES)
    cosines, shapes, sizes, logarithms = _processes(m, count)
    total = normals.sum(axis=0)
    inverse = scaled_inverse(total)
    to_parameters = scores.to_parameters @ inverse
    power = (cosines.T @ sums @ to_parameters.T) ** 2
    excess = power / _white(cosines, normals, inverse, to_parameters)
    rest = (1.0 / shapes) @ excess
    likelihood = -0.5 * logarithms - 0.5 * count * np.log(np.maximum(rest, 1e-300))
    odds = np.full(len(shapes), (1.0 - WHITE_ODDS) / (len(shapes) - 1))
    odds[0] = WHITE_ODDS
    weight = odds[:, None] * np.exp(likelihood - likelihood.max(axis=0))
    factor = np.sum(weight * rest * sizes[:, None], axis=0) / (count * weight.sum(axis=0))
    return factor * np.einsum("pa,ab,pb->p", to_parameters, total, to_parameters), count


def _merged(scores: BlockScores) -> tuple[Floats, Floats]:
    """Return the sums of scores and normal matrices over at most `_BLOCKS` blocks."""
    count = len(scores.starts)
    if count <= _BLOCKS:
        return scores.scores, scores.normals
    edges = (np.arange(_BLOCKS) * count) // _BLOCKS
    return np.add.reduceat(scores.scores, edges, axis=0), np.add.reduceat(scores.normals, edges, axis=0)


def _white(cosines: Floats, normals: Floats, inverse: Floats, to_parameters: Floats) -> Floats:
    """Return the power that white noise of unit variance has after the fit, shape (k, p): what the fit took up is off.

    The scores s_i - N_i I^-1 sum(s) have the covariance N_i delta_ij - N_i I^-1 N_j.
    """
    m, q, _ = normals.shape
    flat = normals.reshape(m, q * q)
    before = ((cosines**2).T @ flat).reshape(-1, q, q)
    shared = (cosines.T @ flat).reshape(-1, q, q)
    own = np.sum((to_parameters @ before) * to_parameters, axis=2)
    taken = np.sum((to_parameters @ (shared @ inverse @ shared)) * to_parameters, axis=2)
    return np.asarray(np.maximum(own - taken, _LEAST_SHARE * own + 1e-300))


@lru_cache(maxsize=8)
def _processes(m: int, count: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return cosines, shape (m, k); 1 + a d_k, (g, k), and 1 + a z, (g,), of white noise and every memory and size.

    The last are the sums of the logarithms of 1 + a d_k, shape (g, 1).
    """
    cosines = np.sqrt(2.0 / m) * np.cos(np.pi * np.outer(np.arange(m) + 0.5, np.arange(1, count + 1)) / m)
    lags = np.arange(m)
    apart = np.abs(lags[:, None] - lags)
    shapes, sizes = [np.ones(count)], [1.0]
    for memory in MEMORIES:
        correlation = np.exp(-lags / (m * memory))[apart]
        at_frequency = np.sum(cosines * (correlation @ cosines), axis=0)
        at_zero = float(correlation.sum()) / m
        shapes += [1.0 + size * at_frequency for size in SIZES]
        sizes += [1.0 + size * at_zero for size in SIZES]
    made = np.array(shapes)
    return cosines, made, np.array(sizes), np.log(made).sum(axis=1)[:, None]
