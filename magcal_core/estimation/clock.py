"""Steps 3 and 5, the clock: coarsely where rows are not clean, then as one unknown beside the sensor's."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.calibration.diagnosis.wrong_input.suspicions import Suspicion
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.loss import LossFit, fit_under_loss
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.estimators.robust_start import rows_looked_at
from magcal_core.calibration.terms.clock import AUTO_AGE_DAYS, ClockFit, fit_with_clock
from magcal_core.calibration.terms.locked_clock import LockedClock
from magcal_core.errors import IndexRangeError, ModelRangeError, OptionError, OrbitMissingError
from magcal_core.estimation.estimate import Estimate, Prepared, still
from magcal_core.estimation.session import LockedSession
from magcal_core.observations import Observations
from magcal_core.reference.referenced_samples import MovableObservations

if TYPE_CHECKING:
    from magcal_core.calibration.terms.trimmed_clock import TrimmedClock

AUTO_LARGEST_S: Final = 120.0
"""Largest offset that is taken unasked, s: a larger one is suspected."""
NEAR_S: Final = 20.0
"""How near a clock that was taken and one from afar are the same."""


def with_clock(estimate: Estimate, near_s: float = 0.0) -> Estimate:
    """Return the estimate with its clock, where one is asked for, or where the orbit is old enough to look for one.

    ``near_s``: offset that a fit to nearly the same samples has, s, where the search begins.

    Raises
    ------
    OptionError
        An offset is asked for and there is no orbit whose clock can differ.
    EstimationError
        The samples do not determine the sensor beside the clock.
    """
    prepared, options = estimate.prepared, estimate.prepared.options
    if options.time_offset == "estimate" and not prepared.referenced.has_orbit:
        raise OptionError(
            "time_offset: the reference comes with the telemetry, there is no orbit whose clock can differ"
        )
    if options.time_offset == "none" or not prepared.referenced.has_orbit:
        return estimate
    if options.time_drift or options.locked_terms == "none":
        return _with_plain_clock(estimate)
    return _beside_locked_errors(estimate, near_s)


def _beside_locked_errors(estimate: Estimate, near_s: float) -> Estimate:
    """Return the estimate with the clock that is asked for or that the data show beside locked errors."""
    prepared = estimate.prepared
    session = prepared.session
    is_asked = prepared.options.time_offset == "estimate"
    # What bad rows leave is no matter of the clock, unless it is asked for.
    is_settled = not is_asked and not estimate.loss.is_clean and _is_settled(prepared.observations)
    far = None if is_settled else session.coarse_clock(prepared.observations, is_clean=estimate.loss.is_clean)
    trimmed, loss, begin_s = None, estimate.loss, 0.0
    if is_asked and far is not None and far.is_found:
        begin_s = far.offset_s
        loss = _loss_at(session, prepared, begin_s)
    elif near_s:
        begin_s = near_s
        loss = _loss_at(session, prepared, begin_s)
    elif not estimate.loss.is_clean and (is_asked or prepared.referenced.age_days > AUTO_AGE_DAYS):
        # A clock that is off makes bad rows of good ones: the loss is chosen again where the clock is roughly right.
        trimmed = coarse_clock(_movable(prepared), prepared.observations)
        begin_s = trimmed.offset_s
        loss = _loss_at(session, prepared, begin_s)
    estimate = replace(estimate, coarse=trimmed, far_clock=far)
    with suppress(OrbitMissingError, ModelRangeError, IndexRangeError):
        tried = _tried(session, prepared, loss, begin_s, is_asked=is_asked)
        is_near = abs(tried.offset_s) <= AUTO_LARGEST_S
        if not is_asked and not (tried.is_material and is_near):
            return replace(estimate, tried_clock=tried)
        taken = _on_all(session, prepared, loss, tried)
        if taken is not None:
            found = replace(loss, fit=taken.fit)
            return replace(
                estimate, observations=taken.observations, fit=taken.fit, loss=found, clock=taken, tried_clock=taken
            )
    return estimate


def _is_settled(observations: Observations) -> bool:
    """Return whether a sensor explains most rows and leaves noise of them, so that the others are bad."""
    from magcal_core.calibration.diagnosis.explanation import Rows
    from magcal_core.calibration.diagnosis.search import FEWEST_ROWS, MOST_ROWS

    used = np.flatnonzero(observations.weights > 0)
    if len(used) < FEWEST_ROWS:
        return False
    few = used[rows_looked_at(len(used), MOST_ROWS)]
    return Rows.of(observations.h_nt[few]).explanation(observations.b_nt[few]).is_settled


def _tried(session: LockedSession, prepared: Prepared, loss: LossFit, begin_s: float, *, is_asked: bool) -> LockedClock:
    """Return the clock that was looked for, on some of very many samples; unasked, one step may be enough."""
    guide, names = guide_of(prepared.estimator), tuple(prepared.observations.regressors)
    few, rows = session.thinned()
    settings = loss.settings
    if settings.begin is not None and rows != slice(None):
        settings = replace(settings, begin=replace(settings.begin, weights=settings.begin.weights[rows]))
    settings = replace(settings, is_gated=False)
    unmoved = prepared.observations.take(rows)
    here = few.at_offset(names, begin_s) if begin_s else unmoved
    if here is None:
        raise OrbitMissingError(f"no orbit reaches {begin_s:.0f} s from the telemetry's clock")
    is_same = guide is prepared.estimator and rows == slice(None)
    fit = loss.fit if is_same else guide.fit(here, settings)
    search = few.clock_search(guide, settings, here, fit)
    if not is_asked and not begin_s:
        found = search.glimpse(few.with_rates(unmoved, 0.0), fit)
        if not found.is_searched:
            return found
    return search.find(unmoved, begin_s)


def _on_all(session: LockedSession, prepared: Prepared, loss: LossFit, found: LockedClock) -> LockedClock | None:
    """Return what was found with the method's own fit to all samples at that clock; None where no orbit reaches."""
    here, fit, estimator = found.observations, found.fit, prepared.estimator
    is_own = guide_of(estimator) is estimator
    if len(here) != len(prepared.observations) or not is_own:
        moved = session.at_offset(tuple(prepared.observations.regressors), found.offset_s)
        if moved is None:
            return None
        here, fit = moved, estimator.fit(moved, replace(loss.settings, is_gated=estimator.is_vector))
    return replace(found, observations=here, fit=with_offset(fit, found.offset_s))


def with_offset(fit: Fit, offset_s: float | None) -> Fit:
    """Return ``fit`` with a clock's offset, s, among its parameters."""
    return replace(fit, parameters=replace(fit.parameters, time_offset_s=offset_s))


def guide_of(estimator: Estimator) -> Estimator:
    """Return the method itself, or its sister that takes a clock where it does not."""
    return estimator if estimator.takes_regressors else ESTIMATORS["vector" if estimator.is_vector else "scalar"]


def _movable(prepared: Prepared) -> MovableObservations:
    return prepared.referenced.movable(prepared.usable, tuple(prepared.observations.regressors))


def _loss_at(session: LockedSession, prepared: Prepared, offset_s: float) -> LossFit:
    """Return the fit under the loss that suits the rows at a clock's offset."""
    here = session.at_offset(tuple(prepared.observations.regressors), offset_s)
    if here is None:
        raise OrbitMissingError(f"no orbit reaches {offset_s:.0f} s from the telemetry's clock")
    return fit_under_loss(prepared.estimator, here, prepared.settings)


def far_suspicion(estimate: Estimate) -> Suspicion | None:
    """Return a clock that is minutes or hours off and was not taken."""
    far, taken = estimate.far_clock, estimate.clock
    if far is None or not far.is_found or (taken is not None and abs(taken.offset_s - far.offset_s) < NEAR_S):
        return None
    text = (
        f"{far.offset_s:.0f} s are to be added to the clock: what the readings leave of |B| would fall to "
        f"{far.ratio_to_plain:.2g} of what it is, {far.next_ratio:.2g} times less than at any other offset within "
        "12 h; time_offset estimate takes it"
    )
    return Suspicion("clock_suspect", text, 1.0 / max(far.ratio_to_plain, 1e-6), f"{far.offset_s:.0f} s")


def _with_plain_clock(estimate: Estimate) -> Estimate:
    """Return the estimate with the clock that no locked errors stand beside: unasked, where the orbit is old."""
    prepared = estimate.prepared
    if prepared.options.time_offset != "estimate" and prepared.referenced.age_days <= AUTO_AGE_DAYS:
        return estimate
    movable = _movable(prepared)
    session = prepared.session
    coarse = None if estimate.loss.is_clean else coarse_clock(movable, prepared.observations)
    loss = estimate.loss if coarse is None else _loss_at(session, prepared, coarse.offset_s)
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
    from magcal_core.calibration.terms.trimmed_clock import clock_rows, trimmed_clock

    rows = np.flatnonzero(observations.weights > 0)
    rows = rows[clock_rows(len(rows))]
    t_utc, q = movable.t_utc[rows], None

    def field_at(offset_s: float) -> np.typing.NDArray[np.float64]:
        return movable.reference.at(t_utc + np.timedelta64(round(offset_s * 1e9), "ns"), q)[0]

    return trimmed_clock(observations.h_nt[rows], field_at)


def _searched(movable: MovableObservations, prepared: Prepared, settings: FitSettings, start_s: float) -> ClockFit:
    guide = guide_of(prepared.estimator)
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
