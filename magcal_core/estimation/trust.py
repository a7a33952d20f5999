"""Steps 8, 9 and 13: errors locked to the orbit, the covariance beside them, and the full matrix where it is asked."""

from __future__ import annotations

from dataclasses import replace

from magcal_core.calibration.estimators.linear_rows import Moments
from magcal_core.calibration.terms.clock import ClockFit
from magcal_core.calibration.terms.full_matrix import FullMatrix, full_matrix, is_worth_a_test, p_of_lower
from magcal_core.calibration.terms.locked import locked_terms, moved_fit
from magcal_core.calibration.terms.locked_clock import LockedClock
from magcal_core.calibration.terms.locked_columns import no_columns
from magcal_core.calibration.uncertainty.consider_errors import reference_shifts
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance, covered_s
from magcal_core.estimation.clock import guide_of
from magcal_core.estimation.estimate import Estimate, Trust, still
from magcal_core.observations import Observations


def with_locked_terms(estimate: Estimate) -> Estimate:
    """Return the estimate where locked errors leave it, with what is known beside it."""
    prepared, fit, o = estimate.prepared, estimate.fit, estimate.observations
    session = prepared.session
    clock = estimate.clock
    has_clock = isinstance(clock, LockedClock)
    rated = session.with_rates(o, clock.offset_s) if clock is not None and has_clock else o
    errors = session.errors(None if clock is None else clock.offset_error_s)
    shifts = reference_shifts(errors, rated, fit)
    is_ours = prepared.options.locked_terms == "auto" and prepared.estimator.takes_regressors
    terms = session.terms(rated, fit, has_clock=has_clock, known=_known(estimate)) if is_ours else None
    duration_s = covered_s(o.t_s)
    full: FullMatrix | None = None
    if is_ours and prepared.estimator.is_vector and is_worth_a_test(p_of_lower(fit)):
        columns = no_columns(len(o)) if terms is None else terms.columns
        full = full_matrix(rated, fit, columns, errors, duration_s)
        full = full if full.is_taken else None
    moved = fit if terms is None else moved_fit(o, fit, terms)
    if terms is not None:
        honest: HonestCovariance | None = terms.honest(fit, len(o), duration_s)
    elif isinstance(clock, LockedClock):
        honest = _beside_clock(estimate, rated)
    else:
        honest = clock.honest if isinstance(clock, ClockFit) else None
    moved = full.fit(o, fit) if full is not None else moved
    return replace(estimate, fit=moved, trust=Trust(fit, terms, honest, shifts, full))


def _beside_clock(estimate: Estimate, rated: Observations) -> HonestCovariance:
    """Return the errors of a fit that locked errors do not move, with those of its clock.

    A method without terms of its own takes them from its sister, which ends at the same minimum: the clock was found
    beside the locked errors, and is as uncertain as they leave it.
    """
    session, duration_s = estimate.prepared.session, covered_s(rated.t_s)
    guide = guide_of(estimate.estimator)
    sister = guide.fit(still(rated), replace(estimate.settings, is_gated=False))
    terms = session.terms(rated, sister, has_clock=True, stays=True)
    if terms is None:
        columns = no_columns(len(rated))
        terms = locked_terms(rated, sister, columns, duration_s, "clock", never=True)
    return terms.honest(sister, len(rated), duration_s)


def _known(estimate: Estimate) -> Moments | None:
    """Return the moments of the very fit, where the look for a clock has taken them."""
    tried = estimate.tried_clock
    if isinstance(tried, LockedClock) and estimate.clock is None and tried.fit is estimate.fit:
        return tried.moments
    return None
