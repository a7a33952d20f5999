"""The one way from telemetry to a result: reference, estimate, honest errors, cross-validation, verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration import ESTIMATORS
from magcal_core.calibration.bootstrap import bootstrap
from magcal_core.calibration.error_budget import ReferenceSource, error_budget
from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations
from magcal_core.calibration.judgement import Circumstances, Judgement, extras_of, judgement_of
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
from magcal_core.calibration.time_offset import AUTO_AGE_DAYS, ClockFit, fit_with_clock, with_rates
from magcal_core.errors import FrameError, IndexRangeError, OptionError, OrbitMissingError
from magcal_core.field.external_knowledge import Storm
from magcal_core.field.sources import FieldFile, FieldSources, Indices
from magcal_core.options import CalibrationOptions, OptionValues
from magcal_core.orbit import Orbit
from magcal_core.orbit.timescales import nanoseconds
from magcal_core.reference import TELEMETRY_POSITION
from magcal_core.referenced import Referenced
from magcal_core.regressor_columns import is_of_scale
from magcal_core.residual_table import residual_table
from magcal_core.samples import Samples
from magcal_core.sensor import SensorModel

__all__ = ["CalibrationOptions", "calibrate"]

Floats = NDArray[np.float64]
Progress = Callable[[float], None]


def calibrate(
    samples: Samples,
    orbits: Sequence[Orbit] = (),
    options: CalibrationOptions | None = None,
    *,
    index: Indices = None,
    field_file: FieldFile = None,
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
    index : Index, path, bytes, open file, or several of them
        Indices of the external field, of which the later holds: what ``field`` needs, and what tells of a storm.
    field_file : CoefficientFile, path, bytes or open file
        Coefficients, where ``field`` has ``file``.
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
    sources = FieldSources.of(index, field_file)
    referenced = Referenced.of(samples, orbits, chosen, sources)
    tell(0.2)
    try:
        estimate = _estimate(referenced, chosen)
    except FrameError as error:
        raise _with_candidate(error, referenced) from error
    tell(0.6)
    left_out = len(samples) - len(estimate.observations)
    suspected = _suspicions(referenced, estimate)
    tried = estimate.tried_clock
    is_clock_known = estimate.clock is not None or (tried is not None and tried.is_bounded)
    circumstances = Circumstances(
        referenced.age_days,
        is_clock_known,
        left_out,
        tuple(f"{one.code}: {one.text}" for one in suspected),
        _reference_shifts(referenced, estimate),
        active,
        _storm(referenced),
    )
    what = (estimate.estimator, estimate.observations, estimate.fit, estimate.settings)
    judgement = judgement_of(*what, circumstances, None if estimate.clock is None else estimate.clock.honest)
    tell(0.95)
    moments = _moments(referenced, estimate, judgement) if with_moments else None
    calibration = _assemble(referenced, estimate, judgement, left_out, suspected, moments)
    tell(1.0)
    return calibration


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """The fit and what it was made of; ``clock`` where its offset is part of the result."""

    estimator: Estimator
    options: CalibrationOptions
    settings: FitSettings
    usable: NDArray[np.bool_]
    observations: Observations
    fit: Fit
    clock: ClockFit | None
    tried_clock: ClockFit | None
    ablation: tuple[Ablation, ...]


def _estimate(referenced: Referenced, options: CalibrationOptions) -> _Estimate:
    """Return the estimate with the regressors and the clock that the options ask for or the data support."""
    estimator: Estimator = WithScaleTerms(ESTIMATORS[options.method])
    settings = FitSettings(options.robust, options.noise_model, options.noise_nt)
    names = () if isinstance(options.regressors, str) else options.regressors
    if names and not estimator.takes_regressors:
        raise OptionError(f"{estimator.name} takes no regressors; scalar and vector do")
    usable = referenced.usable(names, estimator.is_vector)
    observations = referenced.observations(usable, names)
    tried = _clock(referenced, estimator, options, settings, usable, observations)
    clock = tried if tried is not None and (options.time_offset == "estimate" or tried.is_significant) else None
    ablation: tuple[Ablation, ...] = ()
    if options.regressors == "auto" and estimator.takes_regressors:
        at = observations if clock is None else _still(clock.observations)
        choice = choose_regressors(estimator, _with_all_columns(referenced, usable, at), settings)
        names, ablation = choice.names, choice.ablation
        usable = referenced.usable(names, estimator.is_vector)
        observations = referenced.observations(usable, names)
        if clock is not None and names:
            clock = tried = _clock(referenced, estimator, options, settings, usable, observations)
    elif names:
        at = observations if clock is None else _still(clock.observations)
        ablation = ablation_of(estimator, at, settings, [(), names])
    if clock is None:
        fit = estimator.fit(observations, settings)
    else:
        observations = clock.observations
        fit = clock.fit if estimator.takes_regressors else _at_clock(estimator, observations, settings, clock)
    return _Estimate(estimator, options, settings, usable, observations, fit, clock, tried, ablation)


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


def _clock(  # noqa: PLR0917
    referenced: Referenced,
    estimator: Estimator,
    options: CalibrationOptions,
    settings: FitSettings,
    usable: NDArray[np.bool_],
    observations: Observations,
) -> ClockFit | None:
    """Return the fit with a clock where one is asked for, or where the orbit is old enough to look for one."""
    if options.time_offset == "estimate" and not referenced.has_orbit:
        raise OptionError(
            "time_offset: the reference comes with the telemetry, there is no orbit whose clock can differ"
        )
    is_wanted = options.time_offset == "estimate" or (
        options.time_offset == "auto" and referenced.has_orbit and referenced.age_days > AUTO_AGE_DAYS
    )
    if not is_wanted:
        return None
    guide = estimator if estimator.takes_regressors else ESTIMATORS["vector" if estimator.is_vector else "scalar"]
    at = referenced.movable(usable, tuple(observations.regressors)).at
    return fit_with_clock(guide, at, observations, settings, has_drift=options.time_drift)


def _at_clock(estimator: Estimator, observations: Observations, settings: FitSettings, clock: ClockFit) -> Fit:
    """Return the fit of a method that has no clock of its own, at the offset that its sister method found.

    Both end at the same minimum, or within noise of it: the errors are those of the sister, which know of the clock.
    """
    fit = estimator.fit(_still(observations), settings)
    parameters = replace(fit.parameters, time_offset_s=clock.offset_s)
    return replace(
        fit, parameters=parameters, covariance=clock.fit.covariance, blocks=clock.fit.blocks, clock=clock.fit.clock
    )


def _suspicions(referenced: Referenced, estimate: _Estimate) -> tuple[Suspicion, ...]:
    """Return what the data say against their own unit, axes, attitude, frame and clock."""
    clock = estimate.clock
    found = None if clock is None else ClockFinding(-clock.offset_s, clock.offset_error_s)
    is_from_telemetry = referenced.report.orbit_model == TELEMETRY_POSITION
    return suspicions(referenced.samples, clock=found, position_field=referenced.field if is_from_telemetry else None)


def _with_candidate(error: FrameError, referenced: Referenced) -> FrameError:
    """Return ``error`` with the axes or the convention that would fit, where the data show one."""
    found = [one.text for one in suspicions(referenced.samples)]
    return FrameError("; ".join([str(error), *found]))


def _source(referenced: Referenced, estimate: _Estimate) -> ReferenceSource:
    clock = estimate.clock
    return ReferenceSource(
        referenced.report.orbit_model,
        referenced.age_days,
        referenced.field,
        estimate.estimator.is_vector,
        None if clock is None else clock.offset_error_s,
        referenced.external,
    )


def _storm(referenced: Referenced) -> Storm | None:
    """Return the storm that the reference does not know enough of; None where it came with the telemetry."""
    stamps_ns, r_km = referenced.placed()
    return referenced.external.storm(stamps_ns, r_km) if len(stamps_ns) else None


def _external_field(referenced: Referenced) -> dict[str, object] | None:
    """Return what the record says of the external field; None where the reference came with the telemetry."""
    stamps_ns, r_km = referenced.placed()
    return referenced.external.to_dict(stamps_ns, r_km) if len(stamps_ns) else None


def _field_provenance(referenced: Referenced, options: CalibrationOptions) -> dict[str, object]:
    """Return which indices and which file of coefficients the session used."""
    stamps_ns, _ = referenced.placed()
    if options.quiet_only:
        stamps_ns = nanoseconds(referenced.samples.t_utc)
    file, known = referenced.external.sources.file, referenced.external
    return {
        "indices": known.provenance(stamps_ns, is_quiet_only=options.quiet_only) if len(stamps_ns) else [],
        "field_file": None if file is None else file.to_dict(),
    }


def _budget(referenced: Referenced, estimate: _Estimate, judgement: Judgement) -> list[dict[str, object]]:
    found = error_budget(referenced.samples, _source(referenced, estimate), judgement.after.rms_nt)
    return [item.to_dict() for item in found]


def _reference_shifts(referenced: Referenced, estimate: _Estimate) -> tuple[ReferenceShift, ...]:
    used = referenced.samples.take(estimate.usable)
    weighed = replace(estimate.observations, weights=estimate.fit.weights)
    return reference_shifts(used, weighed, estimate.fit.parameters, _source(referenced, estimate))


def _moments(referenced: Referenced, estimate: _Estimate, judgement: Judgement) -> FitMoments | None:
    """Return the moments of the fit, with every column that all its samples have.

    None where its method has none, or where the scale has regressors: moments at fixed slopes would hide their errors.
    """
    if estimate.estimator.name not in MOMENTS_METHODS or any(map(is_of_scale, estimate.fit.parameters.regressors)):
        return None
    o, samples, clock = estimate.observations, referenced.samples, estimate.clock
    whole = {name: np.asarray(samples.housekeeping[name], np.float64)[estimate.usable] for name in samples.housekeeping}
    names = [name for name in usable_columns(whole, np.ones(len(o), bool)) if np.isfinite(whole[name]).all()]
    others = {name: whole[name] for name in names if name not in o.regressors}
    fitted = len(estimate.fit.parameters.regressors)
    offered = dict(list(others.items())[: max(MAX_COLUMNS - fitted, 0)])
    o = replace(o, regressors={**o.regressors, **offered})
    if clock is None and referenced.has_orbit:
        # An ephemeris or an index that ends with the telemetry says nothing of what another clock would have.
        with suppress(OrbitMissingError, IndexRangeError):
            o = with_rates(o, referenced.movable(estimate.usable, ()).at)
    is_clock_fitted = clock is not None and clock.drift_s_per_day is None and not clock.wave_periods_s
    if clock is not None and clock.drift_s_per_day is not None:
        o = _still(o)
    t_utc = samples.t_utc[estimate.usable]
    return moments_of_fit(o, estimate.fit, t_utc, judgement.reference, is_clock_fitted=is_clock_fitted)


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
    lost = int(np.count_nonzero(fit.weights <= 0))
    extras = {
        **fit.extras,
        **extras_of(judgement, parameters, len(estimate.observations)),
        "status_of_fit": str(fit.status),
    }
    extras["suspicions"] = [one.to_dict() for one in suspected]
    extras["external_field"] = _external_field(referenced)
    if (index := referenced.external.series(referenced.placed()[0])) is not None:
        extras["external_index"] = index
    extras["error_budget"] = _budget(referenced, estimate, judgement)
    extras["mounting"] = mounting_of(_oriented(referenced, estimate), parameters).to_dict()
    extras["device_steps"], unseen_devices = _device_steps(samples, estimate)
    if estimate.tried_clock is not None:
        extras["time_offset"] = estimate.tried_clock.to_dict()
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
        matrix=sensor.matrix,
        correction_matrix=sensor.correction_matrix,
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
        sources=_field_provenance(referenced, estimate.options),
        extras=extras,
        moments=moments,
    )


def _oriented(referenced: Referenced, estimate: _Estimate) -> Observations:
    """Return the observations whose attitude is known; a scalar fit may have used others as well."""
    observations = replace(estimate.observations, weights=estimate.fit.weights)
    base_nt = referenced.samples.b_ref_base_nt
    if observations.b_base_nt is not None or base_nt is None or estimate.clock is not None:
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


def _warnings(referenced: Referenced, estimate: _Estimate, judgement: Judgement) -> tuple[str, ...]:
    """Return the warnings of the reference, the fit and the residuals, in that order."""
    found = [*referenced.report.warnings, *estimate.fit.warnings]
    if (storm := _storm(referenced)) is not None:
        found.append(f"storm: {storm.text}")
    if not estimate.estimator.is_vector:
        found.append("reflection_free: |B| alone cannot show an inverted axis, nor a rotation of the whole sensor")
    found += residual_warnings(
        estimate.fit,
        estimate.settings,
        estimate.observations.b_nt,
        judgement.standard_errors,
        is_vector=estimate.estimator.is_vector,
    )
    clock = estimate.tried_clock
    if clock is not None and estimate.clock is None:
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
