"""The one way from telemetry to a result: reference, estimate, honest errors, cross-validation, verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration import ESTIMATORS
from magcal_core.calibration.attitude_suspicions import DOUBTED_RATIO, QUATERNION_RATIO
from magcal_core.calibration.bootstrap import bootstrap
from magcal_core.calibration.error_budget import ReferenceSource, error_budget
from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations
from magcal_core.calibration.judgement import (
    Basis,
    Circumstances,
    Judgement,
    extras_of,
    judgement_of,
    matrix_standard_errors,
    require_determined,
)
from magcal_core.calibration.moments import MAX_COLUMNS, FitMoments, moments_of_fit
from magcal_core.calibration.moments import METHODS as MOMENTS_METHODS
from magcal_core.calibration.monitoring import ActiveSet
from magcal_core.calibration.mounting import mounting_of
from magcal_core.calibration.reference_errors import ReferenceShift, reference_shifts
from magcal_core.calibration.regressors import Ablation, ablation_of, choose_regressors, usable_columns
from magcal_core.calibration.residual_warnings import residual_warnings
from magcal_core.calibration.result import Calibration
from magcal_core.calibration.scale_terms import WithScaleTerms
from magcal_core.calibration.steps import steps_of
from magcal_core.calibration.suspicions import ClockFinding, Suspicion, suspicions
from magcal_core.calibration.terms.full_matrix import FullMatrix, full_matrix, is_worth_a_test, p_of_lower
from magcal_core.calibration.terms.locked import LockedTerms, moved_fit
from magcal_core.calibration.terms.locked_clock import LockedClock
from magcal_core.calibration.terms.white_noise import with_white_noise
from magcal_core.calibration.time_offset import AUTO_AGE_DAYS, ClockFit, fit_with_clock, with_rates
from magcal_core.calibration.uncertainty import HonestCovariance, covered_s
from magcal_core.errors import FrameError, NotObservableError, OptionError, OrbitMissingError
from magcal_core.locked_session import ClockOutcome, LockedSession, clock_of
from magcal_core.options import CalibrationOptions, OptionValues
from magcal_core.orbit import Orbit
from magcal_core.reference import TELEMETRY_POSITION
from magcal_core.referenced import Referenced
from magcal_core.regressor_columns import is_of_scale
from magcal_core.residual_table import residual_table
from magcal_core.samples import SampleFlag, Samples
from magcal_core.sensor import SensorModel

__all__ = ["CalibrationOptions", "calibrate"]

Floats = NDArray[np.float64]
_FRAMES = frozenset({"frame_suspect"})
Progress = Callable[[float], None]


def calibrate(
    samples: Samples,
    orbits: Sequence[Orbit] = (),
    options: CalibrationOptions | None = None,
    *,
    active: ActiveSet | None = None,
    with_moments: bool = False,
    progress: Progress | None = None,
    **overrides: Unpack[OptionValues],
) -> Calibration:
    """Return the calibration of one magnetometer from its telemetry.

    Parameters
    ----------
    samples : Samples
        Telemetry, in any order.
    orbits : sequence of Orbit
        Where the satellite was; not needed where the telemetry brings a reference field or a position.
    options : CalibrationOptions
        How to calibrate; ``overrides`` replace single ones, by the names of `CalibrationOptions`.
    active : ActiveSet
        The calibration that is in force; the verdict tells where the new one differs.
    with_moments : bool
        Whether the result keeps the moments of the fit, from which it can be made again without the samples.
    progress : callable
        Is told the share of the work that is done, from 0 to 1.

    Raises
    ------
    InputError
        The samples, the orbits or the options cannot be used; the subclass says why.
    NotObservableError, TooFewSamplesError
        The samples do not determine the parameters.
    """
    chosen = CalibrationOptions() if options is None else options
    if overrides:
        chosen = CalibrationOptions.from_dict(chosen.to_dict() | dict(overrides))
    tell = progress if progress is not None else lambda _share: None
    tell(0.0)
    referenced = Referenced.of(samples, orbits, chosen)
    tell(0.2)
    try:
        estimate = _estimate(referenced, chosen)
    except (FrameError, NotObservableError) as error:
        raise _with_candidate(error, referenced) from error
    tell(0.6)
    left_out = len(samples) - len(estimate.observations) - _far(referenced)
    suspected = _suspicions(referenced, estimate)
    circumstances = Circumstances(
        referenced.age_days,
        estimate.clock.is_known,
        left_out,
        tuple(f"{one.code}: {one.text}" for one in suspected),
        estimate.shifts,
        active,
    )
    what = (estimate.estimator, estimate.observations, estimate.fit, estimate.settings)
    judgement = judgement_of(*what, circumstances, Basis(estimate.plain, estimate.honest, estimate.full))
    require_determined(estimate.fit, judgement)
    tell(0.95)
    moments = _moments(referenced, estimate, judgement) if with_moments else None
    calibration = _assemble(referenced, estimate, judgement, left_out, suspected, moments)
    tell(1.0)
    return calibration


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """The fit and what it was made of.

    ``plain``: the fit before locked errors moved it; ``honest``: its covariance beside them, without errors of the
    reference, whose ``shifts`` are considered; ``full``: all nine elements of T, where they are the result.
    """

    estimator: Estimator
    options: CalibrationOptions
    settings: FitSettings
    usable: NDArray[np.bool_]
    observations: Observations
    fit: Fit
    plain: Fit
    clock: ClockOutcome
    ablation: tuple[Ablation, ...]
    terms: LockedTerms | None
    honest: HonestCovariance | None
    shifts: tuple[ReferenceShift, ...]
    full: FullMatrix | None = None


def _estimate(referenced: Referenced, options: CalibrationOptions) -> _Estimate:
    """Return the estimate in the order of work: start, clock, noise, regressors, locked terms, full matrix."""
    estimator: Estimator = WithScaleTerms(ESTIMATORS[options.method])
    noise_model = "none" if options.noise_model == "auto" else options.noise_model
    settings = FitSettings(options.robust, noise_model, options.noise_nt, is_gated=estimator.is_vector)
    names = () if isinstance(options.regressors, str) else options.regressors
    if names and not estimator.takes_regressors:
        raise OptionError(f"{estimator.name} takes no regressors; scalar and vector do")
    usable = referenced.usable(names, estimator.is_vector)
    observations = referenced.observations(usable, names)
    clock, observations, fit = _started(referenced, estimator, options, settings, usable, observations)
    settings, fit = _with_noise(referenced, estimator, options, settings, usable, observations, fit)
    ablation: tuple[Ablation, ...] = ()
    if options.regressors == "auto" and estimator.takes_regressors:
        choice = choose_regressors(estimator, _with_all_columns(referenced, usable, observations), settings)
        names, ablation = choice.names, choice.ablation
        if names:
            usable = referenced.usable(names, estimator.is_vector)
            observations = referenced.observations(usable, names)
            clock, observations, fit = _started(referenced, estimator, options, settings, usable, observations)
    elif names:
        ablation = ablation_of(estimator, _still(observations), settings, [(), names])
    return _trusted(
        referenced,
        _Estimate(estimator, options, settings, usable, observations, fit, fit, clock, ablation, None, None, ()),
    )


def _started(  # noqa: PLR0917
    referenced: Referenced,
    estimator: Estimator,
    options: CalibrationOptions,
    settings: FitSettings,
    usable: NDArray[np.bool_],
    observations: Observations,
) -> tuple[ClockOutcome, Observations, Fit]:
    """Return the clock that is taken or was looked for, the observations at it, and the plain fit to them."""
    if options.time_offset == "estimate" and not referenced.has_orbit:
        raise OptionError(
            "time_offset: the reference comes with the telemetry, there is no orbit whose clock can differ"
        )
    if options.time_offset == "none" or not referenced.has_orbit:
        return ClockOutcome(), observations, estimator.fit(observations, settings)
    is_asked = options.time_offset == "estimate"
    guide = estimator if estimator.takes_regressors else ESTIMATORS["vector" if estimator.is_vector else "scalar"]
    if options.time_drift or options.locked_terms == "none":
        clock = _plain_clock(referenced, guide, options, settings, usable, observations)
        fit = None if clock.is_taken else estimator.fit(observations, settings)
    else:
        fit = _fit_or_none(guide, observations, settings)
        session = LockedSession(referenced, usable, estimator.is_vector)
        clock = clock_of(session, guide, settings, observations, fit, is_asked=is_asked)
        if guide is not estimator or fit is None:
            fit = None if clock.is_taken else estimator.fit(observations, settings)
    taken = clock.taken
    if taken is None:
        return clock, observations, fit if fit is not None else estimator.fit(observations, settings)
    fit = taken.fit if guide is estimator else _at_clock(estimator, taken, settings)
    return clock, taken.observations, fit


def _fit_or_none(estimator: Estimator, observations: Observations, settings: FitSettings) -> Fit | None:
    """Return the fit; None where there is none at the telemetry's own clock."""
    try:
        return estimator.fit(observations, settings)
    except NotObservableError:
        return None


def _with_noise(  # noqa: PLR0917
    referenced: Referenced,
    estimator: Estimator,
    options: CalibrationOptions,
    settings: FitSettings,
    usable: NDArray[np.bool_],
    observations: Observations,
    fit: Fit,
) -> tuple[FitSettings, Fit]:
    """Return the settings with white noise in the reading where that moves a parameter, and the fit under them."""
    if options.noise_model != "auto" or estimator.is_vector or not estimator.takes_regressors:
        return settings, fit
    session = LockedSession(referenced, usable, estimator.is_vector)
    shifts = reference_shifts(session.errors(fit.weights, None), _still(observations), fit)
    white = with_white_noise(estimator, _still(observations), settings, fit, [one.shift for one in shifts])
    if white is None:
        return settings, fit
    clocked = replace(white.parameters, time_offset_s=fit.parameters.time_offset_s)
    return replace(settings, noise_model="white"), replace(white, parameters=clocked)


def _trusted(referenced: Referenced, made: _Estimate) -> _Estimate:
    """Return the estimate with locked terms, errors of the reference, and the full matrix where the data ask for it."""
    session = LockedSession(referenced, made.usable, made.estimator.is_vector)
    taken, fit, o = made.clock.taken, made.fit, made.observations
    errors = session.errors(fit.weights, None if taken is None else taken.offset_error_s)
    is_locked = isinstance(taken, LockedClock)
    rated = session.with_rates(o, taken.offset_s) if is_locked and taken is not None else o
    shifts = reference_shifts(errors, rated, fit)
    is_ours = made.options.locked_terms == "auto" and made.estimator.takes_regressors
    terms = session.terms(rated, fit, has_clock=is_locked) if is_ours else None
    if terms is None:
        honest = taken.honest if isinstance(taken, ClockFit) else None
        return replace(made, shifts=shifts, honest=honest)
    full = None
    if made.estimator.is_vector and is_worth_a_test(p_of_lower(fit)):
        full = full_matrix(rated, fit, terms.columns, errors, covered_s(o.t_s))
        full = full if full.is_taken else None
    moved = full.fit(o, fit) if full is not None else moved_fit(o, fit, terms)
    return replace(
        made, fit=moved, terms=terms, honest=terms.honest(fit, len(o), covered_s(o.t_s)), shifts=shifts, full=full
    )


def _still(observations: Observations) -> Observations:
    """Return the observations with their clock fixed where it is."""
    return replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)


def _with_all_columns(referenced: Referenced, usable: NDArray[np.bool_], observations: Observations) -> Observations:
    """Return the observations with every housekeeping column that may be a regressor."""
    keeping = referenced.samples.housekeeping
    names = usable_columns(keeping, usable)
    columns = {name: np.asarray(keeping[name], np.float64)[usable] for name in names}
    is_complete = np.all([np.isfinite(column) for column in columns.values()], axis=0) if columns else slice(None)
    return replace(observations, regressors=columns).take(is_complete)


def _plain_clock(  # noqa: PLR0917
    referenced: Referenced,
    guide: Estimator,
    options: CalibrationOptions,
    settings: FitSettings,
    usable: NDArray[np.bool_],
    observations: Observations,
) -> ClockOutcome:
    """Return the clock, and its drift, without locked errors beside it: unasked, where the orbit is old."""
    is_asked = options.time_offset == "estimate"
    if not is_asked and referenced.age_days <= AUTO_AGE_DAYS:
        return ClockOutcome()
    at = referenced.movable(usable, tuple(observations.regressors)).at
    found = fit_with_clock(guide, at, observations, settings, has_drift=options.time_drift)
    return ClockOutcome(found, is_asked or found.is_significant)


def _at_clock(estimator: Estimator, clock: LockedClock | ClockFit, settings: FitSettings) -> Fit:
    """Return the fit of a method that has no clock of its own, at the offset that its sister method found.

    Both end at the same minimum, or within noise of it: the errors are those of the sister, which know of the clock.
    """
    fit = estimator.fit(_still(clock.observations), settings)
    parameters = replace(fit.parameters, time_offset_s=clock.offset_s)
    return replace(
        fit, parameters=parameters, covariance=clock.fit.covariance, blocks=clock.fit.blocks, clock=clock.fit.clock
    )


def _far(referenced: Referenced) -> int:
    """Return the number of samples that are too far out to be used."""
    return int(np.count_nonzero(referenced.samples.flags & np.uint16(SampleFlag.FAR)))


def _suspicions(referenced: Referenced, estimate: _Estimate) -> tuple[Suspicion, ...]:
    """Return what the data say against their own unit, axes, attitude, frame and clock."""
    clock = estimate.clock.taken
    found = None if clock is None else ClockFinding(-clock.offset_s, clock.offset_error_s)
    is_from_telemetry = referenced.report.orbit_model == TELEMETRY_POSITION
    seen = suspicions(
        referenced.samples,
        clock=found,
        position_field=referenced.field if is_from_telemetry else None,
        quaternion_ratio=QUATERNION_RATIO if estimate.full is None else DOUBTED_RATIO,
    )
    coarse = estimate.clock.suspected
    return seen if coarse is None else (*seen, coarse)


def _with_candidate(error: FrameError | NotObservableError, referenced: Referenced) -> FrameError | NotObservableError:
    """Return ``error`` with the axes or the convention that would fit, where the data show one."""
    found = [one for one in suspicions(referenced.samples, quaternion_ratio=DOUBTED_RATIO) if one.code in _FRAMES]
    if not found:
        return error
    words = "; ".join(
        [str(error), *(one.text if isinstance(error, FrameError) else f"{one.code}: {one.text}" for one in found)]
    )
    return FrameError(words) if isinstance(error, FrameError) else type(error)(words, error.parameters)


def _source(referenced: Referenced, estimate: _Estimate) -> ReferenceSource:
    clock = estimate.clock.taken
    return ReferenceSource(
        referenced.report.orbit_model,
        referenced.age_days,
        referenced.field,
        estimate.estimator.is_vector,
        None if clock is None else clock.offset_error_s,
    )


def _budget(referenced: Referenced, estimate: _Estimate, judgement: Judgement) -> list[dict[str, object]]:
    found = error_budget(referenced.samples, _source(referenced, estimate), judgement.after.rms_nt)
    return [item.to_dict() for item in found]


def _moments(referenced: Referenced, estimate: _Estimate, judgement: Judgement) -> FitMoments | None:
    """Return the moments of the fit, with every column that all its samples have.

    None where its method has none, or where the scale has regressors: moments at fixed slopes would hide their errors.
    """
    if estimate.estimator.name not in MOMENTS_METHODS or any(map(is_of_scale, estimate.fit.parameters.regressors)):
        return None
    o, samples, clock = estimate.observations, referenced.samples, estimate.clock.taken
    whole = {name: np.asarray(samples.housekeeping[name], np.float64)[estimate.usable] for name in samples.housekeeping}
    names = [name for name in usable_columns(whole, np.ones(len(o), bool)) if np.isfinite(whole[name]).all()]
    others = {name: whole[name] for name in names if name not in o.regressors}
    fitted = len(estimate.fit.parameters.regressors)
    offered = dict(list(others.items())[: max(MAX_COLUMNS - fitted, 0)])
    o = replace(o, regressors={**o.regressors, **offered})
    if clock is None and referenced.has_orbit:
        # An ephemeris that ends with the telemetry says nothing of where another clock would have the satellite.
        with suppress(OrbitMissingError):
            o = with_rates(o, referenced.movable(estimate.usable, ()).at)
    is_drifting = isinstance(clock, ClockFit) and clock.drift_s_per_day is not None
    is_clock_fitted = isinstance(clock, ClockFit) and not is_drifting and not clock.wave_periods_s
    if is_drifting:
        o = _still(o)
    t_utc = samples.t_utc[estimate.usable]
    return moments_of_fit(o, estimate.plain, t_utc, judgement.reference, is_clock_fitted=is_clock_fitted)


def _assemble(  # noqa: PLR0917
    referenced: Referenced,
    estimate: _Estimate,
    judgement: Judgement,
    left_out: int,
    suspected: Sequence[Suspicion],
    moments: FitMoments | None,
) -> Calibration:
    fit, samples = estimate.fit, referenced.samples
    parameters = fit.parameters
    names = len(parameters.names)
    sensor = SensorModel(parameters.bias_nt, parameters.scale, parameters.nonorthogonality_deg)
    matrix = sensor.matrix if estimate.full is None else estimate.full.matrix
    lost = int(np.count_nonzero(fit.weights <= 0))
    extras = {
        **fit.extras,
        **extras_of(judgement, parameters, len(estimate.observations)),
        "status_of_fit": str(fit.status),
    }
    extras["suspicions"] = [one.to_dict() for one in suspected]
    extras["error_budget"] = _budget(referenced, estimate, judgement)
    extras["mounting"] = mounting_of(_oriented(referenced, estimate), parameters).to_dict()
    extras["device_steps"], unseen_devices = _device_steps(samples, estimate)
    clocked = estimate.clock.to_dict()
    if clocked is not None:
        extras["time_offset"] = clocked
    extras.update(_trust_extras(estimate, judgement))
    if estimate.ablation:
        extras["ablation"] = [row.to_dict() for row in estimate.ablation]
    if estimate.options.bootstrap:
        resampled = bootstrap(
            estimate.estimator,
            estimate.observations,
            estimate.settings,
            estimate.fit,
            judgement.honest.block_samples,
            estimate.options.bootstrap,
            estimate.options.seed,
        )
        extras["bootstrap"] = resampled.to_dict()
    return Calibration(
        method=estimate.estimator.name,
        field_model=referenced.report.field_model,
        orbit_model=referenced.report.orbit_model,
        data_from=samples.t_utc[0],
        data_until=samples.t_utc[-1],
        parameters=parameters,
        covariance=judgement.honest.covariance[:names, :names],
        standard_errors=judgement.standard_errors,
        formal_standard_errors=fit.formal_standard_errors,
        matrix=matrix,
        correction_matrix=sensor.correction_matrix if estimate.full is None else np.asarray(np.linalg.inv(matrix)),
        candidates=fit.candidates,
        samples=len(estimate.observations) - lost,
        rejected=left_out + lost,
        cross_validated_rms_nt=judgement.cross_validated_rms_nt,
        before=judgement.before,
        after=judgement.after,
        observability=judgement.observability,
        verdict=judgement.verdict,
        warnings=(*_warnings(referenced, estimate, judgement), *unseen_devices),
        residuals=residual_table(samples, estimate.usable, estimate.observations, estimate.fit),
        options=estimate.options.to_dict(),
        orbits=referenced.report.orbits,
        extras=extras,
        moments=moments,
    )


def _trust_extras(estimate: _Estimate, judgement: Judgement) -> dict[str, object]:
    """Return what the record says of locked terms, the error of the field, the noise model and the full matrix."""
    found = judgement.field_error
    full, terms = estimate.full, estimate.terms
    extras: dict[str, object] = {
        "field_error": found.share,
        "field_error_direction": found.direction.tolist(),
        "noise_model_used": estimate.settings.noise_model,
        "locked_terms": None if terms is None else terms.to_dict(),
    }
    if not estimate.estimator.is_vector:
        return extras
    extras["parameters_of"] = "lower" if full is None else "full"
    extras["matrix_standard_errors"] = matrix_standard_errors(estimate.fit.parameters, judgement, full).tolist()
    if full is not None:
        extras["covariance_full"] = full.covariance_by_row.tolist()
    return extras


def _oriented(referenced: Referenced, estimate: _Estimate) -> Observations:
    """Return the observations whose attitude is known; a scalar fit may have used others as well."""
    observations = replace(estimate.observations, weights=estimate.fit.weights)
    base_nt = referenced.samples.b_ref_base_nt
    if observations.b_base_nt is not None or base_nt is None or estimate.clock.is_taken:
        return observations
    base_nt = base_nt[estimate.usable]
    known = np.asarray(np.isfinite(base_nt).all(axis=1))
    return replace(observations.take(known), b_base_nt=np.ascontiguousarray(base_nt[known]))


def _device_steps(samples: Samples, estimate: _Estimate) -> tuple[list[dict[str, object]], tuple[str, ...]]:
    """Return the offsets of the devices that switch on and off, and warnings of those that cannot be seen."""
    columns = {name: np.asarray(column, np.float64)[estimate.usable] for name, column in samples.housekeeping.items()}
    found, warnings = steps_of(
        estimate.observations, columns, estimate.fit.parameters, is_vector=estimate.estimator.is_vector
    )
    return [step.to_dict() for step in found], warnings


def _fit_warnings(estimate: _Estimate) -> list[str]:
    """Return the warnings of the fit, of the full matrix in place of its own, and of the locked terms."""
    found = [text for text in estimate.plain.warnings if not text.startswith("misaligned") or estimate.terms is None]
    if estimate.full is not None:
        found.append(estimate.full.warning)
    if estimate.terms is not None:
        found += (estimate.terms if estimate.full is None else estimate.full.terms).warnings
    return found


def _warnings(referenced: Referenced, estimate: _Estimate, judgement: Judgement) -> tuple[str, ...]:
    """Return the warnings of the reference, the fit and the residuals, in that order."""
    found = [*referenced.report.warnings, *_fit_warnings(estimate)]
    if not estimate.estimator.is_vector:
        found.append("reflection_free: |B| alone cannot show an inverted axis, nor a rotation of the whole sensor")
    found += residual_warnings(
        estimate.fit,
        estimate.settings,
        estimate.observations.b_nt,
        judgement.standard_errors,
        is_vector=estimate.estimator.is_vector,
    )
    clock = estimate.clock.found
    is_told = estimate.clock.is_searched or referenced.age_days > AUTO_AGE_DAYS
    if clock is not None and not estimate.clock.is_taken and is_told:
        found.append(
            f"time_offset_not_used: {clock.offset_s:.2f} +- {clock.offset_error_s:.2f} s is not significant; data like "
            f"these show {clock.test.detectable_s:.2g} s and more"
        )
    if clock is not None and clock.wave_periods_s:
        periods = " and ".join(f"{period_s / 60.0:.0f}" for period_s in clock.wave_periods_s)
        found.append(
            f"bias_waves: the bias swings with a period of {periods} min; the clock was found beside that, the "
            "parameters hold the mean; a column that swings likewise would be a regressor"
        )
    if judgement.cross_validated_rms_nt is None:
        found.append("not_cross_validated: a part of the data alone does not determine the parameters")
    return tuple(found)
