"""The instant since which the regressor ``time`` counts its hours, kept with the parameters."""

from __future__ import annotations

from dataclasses import replace

from magcal_core.estimation.estimate import Estimate
from magcal_core.sensor.regressors import TIME_REGRESSOR


def with_time_base(estimate: Estimate) -> Estimate:
    """Return the estimate whose parameters know since when ``time`` counts: since the first of its samples."""
    samples, parameters = estimate.prepared.referenced.samples, estimate.fit.parameters
    if not parameters.follows_time or TIME_REGRESSOR in samples.housekeeping:
        return estimate
    dated = replace(parameters, time_base_utc=samples.t_utc[estimate.usable][0])
    return replace(estimate, fit=replace(estimate.fit, parameters=dated))
