"""Bootstrap over contiguous blocks of time: standard errors without a formula, on demand.

Notes
-----
A replicate is the estimate from blocks drawn with replacement. Its place is one step away from the fit to all data: no
replicate needs the samples [ANDREWS]_. Where that is not enough shows farthest out, so replicates are refitted to the
samples from there inwards, until a few in a row agree with their steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.uncertainty.reweighted_blocks import moves_of
from magcal_core.errors import EstimationError
from magcal_core.observations import Observations
from magcal_core.sensor.parameters import Parameters

_SAME: Final = 0.1
"""Difference between step and refit, in standard errors of the parameter, up to which they agree."""
_IN_A_ROW: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class Bootstrap:
    """Scatter of the estimate over resampled blocks; ``failed`` replicates did not determine the parameters."""

    replicates: int
    failed: int
    block_samples: int
    standard_errors: Parameters
    low: Parameters
    high: Parameters

    @classmethod
    def of(cls, at: Parameters, values: Floats, failed: int, block_samples: int) -> Bootstrap:
        """Return the scatter of ``values``, shape (m, p), one row a replicate, of parameters like ``at``."""
        errors = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
        low, high = np.quantile(values, [0.025, 0.975], axis=0)
        made = (at.with_vector(one) for one in (errors, low, high))
        return cls(len(values) + failed, failed, block_samples, *made)

    def to_dict(self) -> dict[str, object]:
        """Return the bootstrap as the records have it; ``low`` and ``high`` bound the middle 95 %."""
        return {
            "replicates": self.replicates,
            "failed": self.failed,
            "block_samples": self.block_samples,
            "standard_errors": self.standard_errors.to_dict(),
            "low": self.low.to_dict(),
            "high": self.high.to_dict(),
        }


def bootstrap(  # noqa: PLR0917
    estimator: Estimator,
    observations: Observations,
    settings: FitSettings,
    near: Fit,
    block_samples: int,
    replicates: int,
    seed: int,
) -> Bootstrap:
    """Return the scatter of ``replicates`` fits to blocks of ``block_samples`` samples drawn with replacement.

    Blocks are whole ones of the scores of ``near``, the fit to all data, as many in a row as make ``block_samples``,
    and wrap around the ends, so that every sample has the same chance. The clock stays where ``near`` has it.
    """
    n, cells = len(observations), len(near.blocks.starts)
    in_a_row = max(1, round(block_samples * cells / n))
    counts = drawn(cells, in_a_row, replicates, np.random.default_rng(seed))
    lengths = np.diff([*near.blocks.starts, n])
    at = replace(near.parameters, time_offset_s=None)
    still = replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)

    def refit(replicate: int) -> Floats:
        weights = observations.weights * np.repeat(counts[replicate], lengths)
        return estimator.refit(replace(still, weights=weights), settings, near).vector - at.vector

    moves, failed = _settled(moves_of(near, counts, is_vector=estimator.is_vector), refit)
    if failed == replicates:
        raise EstimationError(f"bootstrap: none of {replicates} replicates determines the parameters")
    return Bootstrap.of(at, at.vector + moves, failed, max(1, round(n * in_a_row / cells)))


def _settled(moves: Floats, refit: Callable[[int], Floats]) -> tuple[Floats, int]:
    """Return the moves of the replicates, shape (m, p), refitted from the farthest inwards, and how many have none."""
    low, high = np.quantile(moves, [0.16, 0.84], axis=0)
    spread = np.maximum(0.5 * (high - low), 1e-300)
    settled, failed, agreed = moves.copy(), [], 0
    for i in np.argsort(-np.max(np.abs(moves) / spread, axis=1), kind="stable").tolist():
        if agreed == _IN_A_ROW:
            break
        try:
            settled[i] = refit(i)
        except EstimationError:
            failed.append(i)
            continue
        agreed = agreed + 1 if np.max(np.abs(settled[i] - moves[i]) / spread) <= _SAME else 0
    return np.delete(settled, failed, axis=0), len(failed)


def drawn(cells: int, in_a_row: int, replicates: int, random: np.random.Generator) -> Floats:
    """Return how often each of ``cells`` was drawn, shape (replicates, cells), so many ``in_a_row`` at a time."""
    first = random.integers(0, cells, (replicates, max(1, round(cells / in_a_row))))
    at = (first[:, :, None] + np.arange(in_a_row)) % cells
    return np.stack([np.bincount(one.ravel(), minlength=cells) for one in at]).astype(np.float64)
