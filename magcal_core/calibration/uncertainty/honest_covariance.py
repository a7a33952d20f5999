"""Honest errors: covariance that holds under correlated and heteroscedastic residuals, from the scores of the fit.

Notes
-----
V = diag(r) V0 diag(r): correlations are those of V0, the formal covariance (or the posterior one beside errors locked
to the orbit, `terms.locked`), r is the honest over the formal standard error of each parameter, at least 1. Honest
variances come from the lowest frequencies of the parameters' own scores (`low_frequencies`). Correlations from blocks
of the same scores would be those of some eight independent vectors: the quadratic form of nine errors then has a mean
of 13 under white noise in place of 9, and of hundreds where errors remember an orbit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.uncertainty.low_frequencies import longest_memory_s, low_frequency_variances
from magcal_core.numerics.blocks import BlockScores
from magcal_core.numerics.linear_algebra import scaled_inverse

MIN_BLOCKS: Final = 8
"""Fewer blocks leave the covariance to chance."""
_CORRELATED: Final = 0.2
"""Correlation of scores below which they pass for independent."""
_BLOCK_OVER_CORRELATION: Final = 2.5
"""Block length over the lag at which the correlation is gone: a block must be longer, its edges are correlated."""
_STEPS: Final = 256
_GAP: Final = 4.0
"""Longest step between samples, in usual ones, that time passes in."""
_T_95: Final = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class HonestCovariance:
    """Covariance of the parameters, in the order of `Parameters.names`, and how long a block of samples remembers.

    The covariance contains Student's t: 1.96 standard errors are 95 % although the frequencies are few.
    ``longest_memory_s``: up to which correlation time, s, errors were allowed for.
    """

    covariance: Floats
    blocks: int
    block_samples: int
    longest_memory_s: float


def covered_s(t_s: Floats) -> float:
    """Return the time that samples at ``t_s``, shape (n,), s, ascending, cover: a gap counts as four usual steps."""
    at = np.linspace(0, len(t_s) - 1, min(len(t_s), _STEPS)).astype(np.intp)
    steps = np.diff(t_s[at])
    return float(np.minimum(steps, _GAP * np.median(steps)).sum()) if len(steps) else 0.0


def honest_covariance(scores: BlockScores, formal: Floats, samples: int, duration_s: float) -> HonestCovariance:
    """Return the covariance with the correlations of ``formal``, shape (p, p), and the variances that the scores show.

    ``duration_s``: time that the samples cover, s (`covered_s`).
    """
    return with_blocks(widened_covariance(scores, formal, duration_s), scores, samples, duration_s)


def widened_covariance(scores: BlockScores, formal: Floats, duration_s: float) -> Floats:
    """Return the matrix of `honest_covariance` alone."""
    widening = np.sqrt(honest_variances(scores, formal, duration_s) / np.maximum(np.diag(formal), 1e-300))
    return np.asarray(formal * np.outer(widening, widening))


def with_blocks(covariance: Floats, scores: BlockScores, samples: int, duration_s: float) -> HonestCovariance:
    """Return ``covariance`` with how many blocks of the scores are nearly independent, and how long these are."""
    count = len(scores.starts)
    per_block = _block_length(scores)
    edges = np.arange(0, count, per_block)
    if len(edges) > MIN_BLOCKS and count - edges[-1] < per_block / 2:
        edges = edges[:-1]
    block_samples = max(1, round(samples * per_block / count))
    return HonestCovariance(covariance, len(edges), block_samples, longest_memory_s(duration_s))


def honest_variances(scores: BlockScores, formal: Floats, duration_s: float) -> Floats:
    """Return the variance of each reported parameter, shape (p,), Student's t contained, none below its ``formal`` one.

    ``duration_s``: time that the samples cover, s (`covered_s`).
    """
    return never_below(*low_frequency_variances(scores, duration_s), np.diag(formal))


def never_below(variances: Floats, frequencies: int, formal: Floats) -> Floats:
    """Return ``variances`` of so many frequencies, shape (p,), with Student's t, none below its ``formal`` one."""
    return np.maximum(variances * (student_95(frequencies) / 1.96) ** 2, formal)


def _block_length(scores: BlockScores) -> int:
    """Return how many of the short blocks make one whose sum is nearly independent of its neighbours'."""
    inverse = scaled_inverse(scores.normals.sum(axis=0))
    series = scores.scores @ inverse @ scores.to_parameters.T
    series = series - series.mean(axis=0)
    count = len(series)
    longest = max(1, count // MIN_BLOCKS)
    lags = min(count - 1, longest + 1)
    size = np.maximum(np.sum(series**2, axis=0), 1e-300)
    correlation = [float(np.max(np.sum(series[lag:] * series[:-lag], axis=0) / size)) for lag in range(1, lags + 1)]
    noise = 1.0 / np.sqrt(count)
    for lag, value in enumerate(correlation, start=1):
        if value < max(_CORRELATED, noise):
            return 1 if lag == 1 and value < noise else min(longest, max(1, round(_BLOCK_OVER_CORRELATION * lag)))
    return longest


def student_95(freedom: int) -> float:
    """Return Student's t for a two-sided 95 % interval; tabulated to 15 degrees of freedom, by series beyond."""
    if freedom < 1:
        return _T_95[0]
    if freedom <= len(_T_95):
        return _T_95[freedom - 1]
    z = 1.959964
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
