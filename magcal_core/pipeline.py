"""The one way from telemetry to a result: reference, estimate, honest errors, cross-validation, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Unpack

import numpy as np

from magcal_core.arrays import Progress
from magcal_core.bias_in_session import Session, wants_moments, with_moving_bias
from magcal_core.calibration.diagnosis.device_steps import steps_of
from magcal_core.calibration.diagnosis.mounting import mounting_of
from magcal_core.calibration.diagnosis.residual_table import residual_table
from magcal_core.calibration.diagnosis.residual_warnings import residual_warnings
from magcal_core.calibration.diagnosis.wrong_input.suspicions import ClockFinding, Suspicion, suspicions
from magcal_core.calibration.refit.moments import MAX_COLUMNS, FitMoments, moments_of_fit
from magcal_core.calibration.refit.moments import METHODS as MOMENTS_METHODS
from magcal_core.calibration.result import Calibration
from magcal_core.calibration.sessions.monitoring import ActiveSet
from magcal_core.calibration.terms.clock import with_rates
from magcal_core.calibration.terms.regressor_selection import usable_columns
from magcal_core.calibration.uncertainty.bootstrap import bootstrap
from magcal_core.calibration.uncertainty.consider_errors import ReferenceShift, reference_shifts
from magcal_core.calibration.verdict.assessment import Circumstances, Judgement, extras_of, judgement_of
from magcal_core.errors import FrameError, IndexRangeError, OrbitMissingError
from magcal_core.estimation import _Estimate, _estimate, _still
from magcal_core.field.external_knowledge import Storm
from magcal_core.field.sources import FieldFile, FieldSources, GivenIndices
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions, OptionValues
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.reference.columns import TELEMETRY_POSITION
from magcal_core.reference.error_budget import ReferenceSource, error_budget
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.regressors import is_of_scale

__all__ = ["CalibrationOptions", "calibrate"]


def calibrate(
    samples: Samples,
    orbits: Sequence[Orbit] = (),
    options: CalibrationOptions | None = None,
    *,
    index: GivenIndices = None,
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
    moments = _moments(referenced, estimate, judgement) if with_moments or wants_moments(chosen) else None
    calibration = _assemble(referenced, estimate, judgement, left_out, suspected, moments if with_moments else None)

    def again(part: Samples, options: CalibrationOptions) -> Calibration:
        return calibrate(
            part,
            orbits,
            options,
            index=sources.indices,
            field_file=sources.file,
            active=active,
            with_moments=with_moments,
        )

    calibration = with_moving_bias(calibration, moments, Session(samples, orbits, chosen), again)
    tell(1.0)
    return calibration


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
        referenced.report.interpolation_km,
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
