"""Step 6, the noise model: white noise in the reading, where that moves a parameter by half its standard error."""

from __future__ import annotations

from dataclasses import replace

from magcal_core.calibration.terms.white_noise import may_matter, with_white_noise
from magcal_core.calibration.uncertainty.consider_errors import reference_shifts
from magcal_core.estimation.clock import with_offset
from magcal_core.estimation.estimate import Estimate, still


def with_noise(estimate: Estimate) -> Estimate:
    """Return the estimate under the noise model that the options ask for or the data need."""
    prepared, fit = estimate.prepared, estimate.fit
    is_open = prepared.options.noise_model == "auto" and prepared.settings.noise_model == "none"
    if not is_open or prepared.estimator.is_vector or not prepared.estimator.takes_regressors:
        return estimate
    if not may_matter(estimate.observations, fit):
        return estimate
    session = prepared.session
    o, settings = still(estimate.observations), replace(estimate.settings, is_gated=False)
    shifts = reference_shifts(session.errors(None), o, fit)
    white = with_white_noise(prepared.estimator, o, settings, fit, [one.shift for one in shifts])
    if white is None:
        return estimate
    white = with_offset(white, fit.parameters.time_offset_s)
    loss = replace(estimate.loss, fit=white, settings=replace(estimate.loss.settings, noise_model="white"))
    noisy = replace(prepared, settings=replace(prepared.settings, noise_model="white"))
    return replace(estimate, prepared=noisy, observations=o, fit=white, loss=loss)
