"""Bootstrap over contiguous blocks of time: standard errors without a formula, on demand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations
from magcal_core.calibration.result import Parameters
from magcal_core.errors import EstimationError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Bootstrap:
    """Scatter of the estimate over resampled blocks; ``failed`` replicates did not determine the parameters."""

    replicates: int
    failed: int
    block_samples: int
    standard_errors: Parameters
    low: Parameters
    high: Parameters

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

    A sample's weight is the number of times that its block was drawn; blocks wrap around the ends, so that every sample
    has the same chance. The clock stays where ``near``, the fit to all data, has it.
    """
    n = len(observations)
    random = np.random.default_rng(seed)
    still = replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)
    drawn = max(1, round(n / block_samples))
    estimates, failed = [], 0
    for _ in range(replicates):
        starts = random.integers(0, n, drawn)
        at = (starts[:, None] + np.arange(block_samples)) % n
        counts = np.bincount(at.ravel(), minlength=n).astype(np.float64)
        try:
            resampled = replace(still, weights=observations.weights * counts)
            estimates.append(estimator.refit(resampled, settings, near))
        except EstimationError:
            failed += 1
    if not estimates:
        raise EstimationError(f"bootstrap: none of {replicates} replicates determines the parameters")
    values = np.array([one.vector for one in estimates])
    shape = estimates[0].with_vector
    errors = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
    low, high = np.quantile(values, [0.025, 0.975], axis=0)
    return Bootstrap(replicates, failed, block_samples, shape(errors), shape(low), shape(high))
