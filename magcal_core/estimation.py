"""The estimate of one session: which regressors, which clock, then the fit."""

from __future__ import annotations

from magcal_core.estimation.clock import with_clock
from magcal_core.estimation.estimate import Estimate, Prepared
from magcal_core.estimation.noise import with_noise
from magcal_core.estimation.regressor_choice import with_regressors
from magcal_core.estimation.start_and_loss import started
from magcal_core.estimation.trust import with_locked_terms
from magcal_core.options import CalibrationOptions
from magcal_core.reference.referenced_samples import Referenced


def _estimate(referenced: Referenced, options: CalibrationOptions) -> Estimate:
    """Return the estimate: start and loss, clock, noise model, regressors, and what locked errors leave of it."""
    prepared = Prepared.of(referenced, options)
    return with_locked_terms(with_regressors(with_noise(with_clock(started(prepared)))))
