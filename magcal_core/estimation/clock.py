"""Steps 3 and 5, the clock: coarsely where rows are not clean, then as one unknown beside the sensor's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magcal_core.calibration import ESTIMATORS
from magcal_core.calibration.estimators.loss import LossFit, fit_under_loss
from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations
from magcal_core.calibration.terms.trimmed_clock import TrimmedClock, clock_rows, trimmed_clock
from magcal_core.calibration.time_offset import AUTO_AGE_DAYS, ClockFit, fit_with_clock
from magcal_core.errors import OptionError
from magcal_core.estimation.estimate import Estimate, Prepared, still
from magcal_core.referenced import MovableObservations


def with_clock(estimate: Estimate) -> Estimate:
    """Return the estimate with its clock, where one is asked for, or where the orbit is old enough to look for one.

    Raises
    ------
    OptionError
        An offset is asked for and there is no orbit whose clock can differ.
    EstimationError
        The samples do not determine the sensor beside the clock.
    """
    prepared = estimate.prepared
    if not _is_wanted(prepared):
        return estimate
    movable = prepared.referenced.movable(prepared.usable, tuple(prepared.observations.regressors))
    # A clock that is off makes bad rows of good ones: the loss is chosen again where the clock is roughly right.
    coarse = None if estimate.loss.is_clean else coarse_clock(movable, prepared.observations)
    loss = estimate.loss if coarse is None else _loss_at(movable, prepared, coarse)
    tried = _searched(movable, prepared, loss.settings, 0.0 if coarse is None else coarse.offset_s)
    if prepared.options.time_offset != "estimate" and not tried.is_significant:
        return replace(estimate, coarse=coarse, tried_clock=tried)
    fit = tried.fit
    if not prepared.estimator.takes_regressors:
        fit = _at_clock(prepared.estimator, tried.observations, loss.settings, tried)
    found = replace(loss, fit=fit)
    return replace(
        estimate, observations=tried.observations, fit=fit, loss=found, coarse=coarse, clock=tried, tried_clock=tried
    )


def coarse_clock(movable: MovableObservations, observations: Observations) -> TrimmedClock:
    """Return the offset that least trimmed squares ask for, from some of the rows."""
    rows = np.flatnonzero(observations.weights > 0)
    rows = rows[clock_rows(len(rows))]
    t_utc, q = movable.t_utc[rows], None

    def field_at(offset_s: float) -> np.typing.NDArray[np.float64]:
        return movable.reference.at(t_utc + np.timedelta64(round(offset_s * 1e9), "ns"), q)[0]

    return trimmed_clock(observations.h_nt[rows], field_at)


def _is_wanted(prepared: Prepared) -> bool:
    options, referenced = prepared.options, prepared.referenced
    if options.time_offset == "estimate" and not referenced.has_orbit:
        raise OptionError(
            "time_offset: the reference comes with the telemetry, there is no orbit whose clock can differ"
        )
    is_old = referenced.has_orbit and referenced.age_days > AUTO_AGE_DAYS
    return options.time_offset == "estimate" or (options.time_offset == "auto" and is_old)


def _loss_at(movable: MovableObservations, prepared: Prepared, coarse: TrimmedClock) -> LossFit:
    shift_s = np.full(len(prepared.observations), coarse.offset_s)
    return fit_under_loss(prepared.estimator, movable.at(shift_s), prepared.settings)


def _searched(movable: MovableObservations, prepared: Prepared, settings: FitSettings, start_s: float) -> ClockFit:
    estimator = prepared.estimator
    guide = estimator if estimator.takes_regressors else ESTIMATORS["vector" if estimator.is_vector else "scalar"]
    has_drift = prepared.options.time_drift
    return fit_with_clock(guide, movable.at, prepared.observations, settings, has_drift=has_drift, start_s=start_s)


def _at_clock(estimator: Estimator, observations: Observations, settings: FitSettings, clock: ClockFit) -> Fit:
    """Return the fit of a method that has no clock of its own, at the offset that its sister method found.

    Both end at the same minimum, or within noise of it: the errors are those of the sister, which know of the clock.
    """
    fit = estimator.fit(still(observations), settings)
    parameters = replace(fit.parameters, time_offset_s=clock.offset_s)
    return replace(
        fit, parameters=parameters, covariance=clock.fit.covariance, blocks=clock.fit.blocks, clock=clock.fit.clock
    )
