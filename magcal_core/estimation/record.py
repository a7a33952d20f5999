"""The result of a calibration, put together from the estimate and what is said of it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magcal_core.calibration.diagnosis.device_steps import steps_of
from magcal_core.calibration.diagnosis.mounting import mounting_of
from magcal_core.calibration.diagnosis.residual_table import residual_table
from magcal_core.calibration.diagnosis.residual_warnings import residual_warnings
from magcal_core.calibration.refit.moments import MAX_COLUMNS, FitMoments, moments_of_fit
from magcal_core.calibration.result import Calibration
from magcal_core.calibration.terms.clock import AUTO_AGE_DAYS, ClockFit, with_rates
from magcal_core.calibration.terms.locked_clock import LockedClock
from magcal_core.calibration.terms.regressor_selection import untold_terms, usable_columns
from magcal_core.calibration.verdict.assessment import Judgement, extras_of, matrix_standard_errors
from magcal_core.errors import IndexRangeError, OrbitMissingError
from magcal_core.estimation.averaging import said_of_averaging, untold_averaging
from magcal_core.estimation.estimate import Estimate, still
from magcal_core.estimation.gyros import gyros_of, mounting_by_gyros
from magcal_core.estimation.judgement import Judged, source_of_reference, storm_of
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.reference.error_budget import error_budget
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.sensor.regressors import is_of_scale

if TYPE_CHECKING:
    from magcal_core.calibration.diagnosis.cause import Diagnosis


def calibration_of(
    estimate: Estimate, judged: Judged, diagnosis: Diagnosis | None, *, with_moments: bool, for_refits: bool = True
) -> Calibration:
    """Return the calibration.

    ``with_moments``: with the moments of its fit, where its method has them; ``for_refits``: with what refits need of
    hidden errors in them.
    """
    fit, judgement, referenced = estimate.fit, judged.judgement, estimate.prepared.referenced
    parameters, samples = fit.parameters, referenced.samples
    names = len(parameters.names)
    full = None if estimate.trust is None else estimate.trust.full
    lost = int(np.count_nonzero(fit.weights <= 0))
    steps, unseen_devices = _device_steps(estimate)
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
        matrix=parameters.matrix if full is None else full.matrix,
        correction_matrix=parameters.correction_matrix if full is None else np.asarray(np.linalg.inv(full.matrix)),
        candidates=fit.candidates,
        samples=len(estimate.observations) - lost,
        rejected=len(samples) - len(estimate.observations) + lost,
        cross_validated_rms_nt=judgement.cross_validated_rms_nt,
        before=judgement.before,
        after=judgement.after,
        observability=judgement.observability,
        verdict=judgement.verdict,
        warnings=(*_warnings(estimate, judged), *unseen_devices),
        residuals=residual_table(samples, estimate.usable, estimate.observations, fit),
        options=estimate.options.to_dict(),
        orbits=referenced.report.orbits,
        sources=_field_provenance(referenced, estimate.options),
        extras={**_extras(estimate, judged, diagnosis), "device_steps": steps},
        moments=_moments(estimate, judgement, for_refits=for_refits) if with_moments else None,
    )


def _extras(estimate: Estimate, judged: Judged, diagnosis: Diagnosis | None) -> dict[str, object]:
    """Return what the record carries beside its own fields."""
    fit, judgement, gyros = estimate.fit, judged.judgement, gyros_of(estimate)
    extras: dict[str, object] = {
        **fit.extras,
        **extras_of(judgement, fit.parameters, len(estimate.observations)),
        "status_of_fit": str(fit.status),
        "robust": estimate.loss_use.to_dict(),
        "data_quality": judged.quality.to_dict(),
        "diagnosis": None if diagnosis is None else diagnosis.to_dict(),
        "suspicions": [one.to_dict() for one in judged.suspected],
        "external_field": _external_field(estimate.prepared.referenced),
        "error_budget": _budget(estimate, judgement),
        "mounting": mounting_by_gyros(estimate, mounting_of(_oriented(estimate), fit.parameters), gyros).to_dict(),
    }
    if (averaging := said_of_averaging(estimate)) is not None:
        extras["averaging"] = averaging.to_dict()
    referenced = estimate.prepared.referenced
    if (index := referenced.external.series(referenced.placed()[0])) is not None:
        extras["external_index"] = index
    if estimate.tried_clock is not None:
        far = estimate.far_clock
        extras["time_offset"] = {
            **estimate.tried_clock.to_dict(),
            "is_taken": estimate.clock is not None,
            "coarse": None if far is None else far.to_dict(),
        }
    extras.update(_trust(estimate, judgement))
    if estimate.ablation:
        extras["ablation"] = [row.to_dict() for row in estimate.ablation]
    if gyros is not None:
        extras["gyro"] = gyros.to_dict()
    if estimate.candidates:
        extras["regressor_candidates"] = [one.to_dict() for one in estimate.candidates]
    return {**extras, **_resampled(estimate, judgement)}


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


def _trust(estimate: Estimate, judgement: Judgement) -> Mapping[str, object]:
    """Return what the record says of locked terms, the error of the field, the noise model and the full matrix."""
    trust, error = estimate.trust, judgement.field_error
    terms = None if trust is None else trust.terms
    full = None if trust is None else trust.full
    found: dict[str, object] = {
        "field_error": error.share,
        "field_error_direction": error.direction.tolist(),
        "noise_model_used": estimate.settings.noise_model,
        "locked_terms": None if terms is None else terms.to_dict(),
    }
    if terms is None:
        found["locked_terms_why"] = _why_no_terms(estimate)
    if estimate.estimator.is_vector:
        found["parameters_of"] = "lower" if full is None else "full"
        found["matrix_standard_errors"] = matrix_standard_errors(estimate.fit.parameters, judgement, full).tolist()
    if full is not None:
        found["covariance_full"] = full.covariance_by_row.tolist()
    return found


def _why_no_terms(estimate: Estimate) -> str:
    if estimate.options.locked_terms == "none":
        return "not asked for"
    if not estimate.estimator.takes_regressors:
        return f"{estimate.estimator.name} takes none; scalar and vector do"
    return "neither an orbit nor positions: nothing is known that a bias could be locked to"


def _resampled(estimate: Estimate, judgement: Judgement) -> Mapping[str, object]:
    if not estimate.options.bootstrap:
        return {}
    from magcal_core.calibration.uncertainty.bootstrap import bootstrap

    found = bootstrap(
        estimate.estimator,
        estimate.observations,
        estimate.settings,
        estimate.fit,
        judgement.honest.block_samples,
        estimate.options.bootstrap,
        estimate.options.seed,
    )
    return {"bootstrap": found.to_dict()}


def _budget(estimate: Estimate, judgement: Judgement) -> list[dict[str, object]]:
    samples = estimate.prepared.referenced.samples
    averaging = said_of_averaging(estimate)
    unknown = None if averaging is None else averaging.budget_item
    beside = () if unknown is None else (unknown,)
    found = error_budget(samples, source_of_reference(estimate), judgement.after.rms_nt, beside=beside)
    return [item.to_dict() for item in found]


def _moments(estimate: Estimate, judgement: Judgement, *, for_refits: bool) -> FitMoments | None:
    """Return the moments of the fit, with every column that all its samples have.

    None where its method has none, or where the scale has regressors: moments at fixed slopes would hide their errors.
    """
    if not estimate.estimator.has_moments or any(map(is_of_scale, estimate.fit.parameters.regressors)):
        return None
    referenced = estimate.prepared.referenced
    o, samples, clock = estimate.observations, referenced.samples, estimate.clock
    whole = {name: np.asarray(samples.housekeeping[name], np.float64)[estimate.usable] for name in samples.housekeeping}
    names = [name for name in usable_columns(whole, np.ones(len(o), bool)) if np.isfinite(whole[name]).all()]
    others = {name: whole[name] for name in names if name not in o.regressors}
    fitted = len(estimate.fit.parameters.regressors)
    offered = dict(list(others.items())[: max(MAX_COLUMNS - fitted, 0)])
    o = replace(o, regressors={**o.regressors, **offered})
    if clock is None and referenced.has_orbit and not for_refits:
        # Nobody asks for the clock then; it keeps its place, so that blocks are cut as ever.
        base = None if o.b_base_nt is None else np.zeros((len(o), 1, 3))
        o = replace(o, rate_nt_s=np.zeros((len(o), 1)), rate_base_nt_s=base)
    elif clock is None and referenced.has_orbit:
        # An ephemeris or an index that ends with the telemetry says nothing of what another clock would have.
        with suppress(OrbitMissingError, IndexRangeError):
            o = with_rates(o, referenced.movable(estimate.usable, ()).at)
    is_drifting = isinstance(clock, ClockFit) and clock.drift_s_per_day is not None
    is_clock_fitted = clock is not None and not is_drifting and not clock.wave_periods_s
    if is_drifting:
        o = still(o)
    elif isinstance(clock, LockedClock) and is_clock_fitted:
        o = estimate.prepared.session.with_rates(o, clock.offset_s)
    t_utc = samples.t_utc[estimate.usable]
    plain = estimate.fit if estimate.trust is None else estimate.trust.plain
    # A clock that is fitted takes up that the orbit is late; a refit may hold it, and considers that in its place.
    errors = estimate.prepared.session.errors(None if is_clock_fitted or clock is None else clock.offset_error_s)
    terms = None if estimate.trust is None else estimate.trust.terms
    hidden = (errors, terms) if for_refits else (None, None)
    made = moments_of_fit(o, plain, t_utc, judgement.reference, *hidden, is_clock_fitted=is_clock_fitted)
    if terms is None:
        return made
    return replace(made, trusted=np.stack([estimate.fit.parameters.vector, judgement.standard_errors.vector]))


def _oriented(estimate: Estimate) -> Observations:
    """Return the observations whose attitude is known; a scalar fit may have used others as well."""
    observations = replace(estimate.observations, weights=estimate.fit.weights)
    base_nt = estimate.prepared.referenced.samples.b_ref_base_nt
    if observations.b_base_nt is not None or base_nt is None or estimate.clock is not None:
        return observations
    base_nt = base_nt[estimate.usable]
    known = np.asarray(np.isfinite(base_nt).all(axis=1))
    return replace(observations.take(known), b_base_nt=np.ascontiguousarray(base_nt[known]))


def _device_steps(estimate: Estimate) -> tuple[list[dict[str, object]], tuple[str, ...]]:
    """Return the offsets of the devices that switch on and off, and warnings of those that cannot be seen."""
    samples = estimate.prepared.referenced.samples
    columns = {name: np.asarray(column, np.float64)[estimate.usable] for name, column in samples.housekeeping.items()}
    found, warnings = steps_of(
        estimate.observations, columns, estimate.fit.parameters, is_vector=estimate.estimator.is_vector
    )
    return [step.to_dict() for step in found], warnings


def _is_told(estimate: Estimate) -> bool:
    """Return whether a clock that was not taken is worth a warning: not where one step showed no need of a search."""
    clock = estimate.tried_clock
    is_searched = not isinstance(clock, LockedClock) or clock.is_searched
    return is_searched or estimate.prepared.referenced.age_days > AUTO_AGE_DAYS


def _fit_warnings(estimate: Estimate) -> list[str]:
    """Return the warnings of the fit, with the full matrix in place of its own, and those of the locked terms."""
    trust = estimate.trust
    if trust is None or (trust.terms is None and trust.full is None):
        return list(estimate.fit.warnings)
    replaced = () if trust.plain.full_matrix is None else trust.plain.full_matrix.warnings
    found = [text for text in trust.plain.warnings if text not in replaced]
    if trust.full is None:
        return found if trust.terms is None else [*found, *trust.terms.warnings]
    return [*found, trust.full.warning, *trust.full.terms.warnings]


def _untold(estimate: Estimate) -> list[str]:
    """Return what `auto` did not take although unseen blocks bear it out."""
    plain_nt = {row.regressors: row.cross_validated_rms_nt for row in estimate.ablation}
    found = []
    for row in untold_terms(estimate.ablation, tuple(estimate.fit.parameters.regressors)):
        before_nt, after_nt = plain_nt.get(row.regressors[:-1]), row.cross_validated_rms_nt
        falls = "" if before_nt is None or after_nt is None else f" from {before_nt:.1f} to {after_nt:.1f} nT"
        found.append(
            f"term_needs_another_session: {row.regressors[-1]} lowers the residual on unseen blocks{falls} and was not "
            "taken: this session alone does not tell it from a slow change of the bias"
        )
    return found


def _warnings(estimate: Estimate, judged: Judged) -> tuple[str, ...]:
    """Return the warnings of the reference, the rows, the fit and the residuals, in that order."""
    judgement = judged.judgement
    found = [*estimate.prepared.referenced.report.warnings, *judged.quality.warnings, *_fit_warnings(estimate)]
    if estimate.odd_light is not None:
        found.append(estimate.odd_light.warning)
    if (storm := storm_of(estimate.prepared.referenced)) is not None:
        found.append(f"storm: {storm.text}")
    if (averaging := said_of_averaging(estimate)) is not None:
        found += averaging.warnings(estimate.fit.parameters.scale, judgement.standard_errors.scale)
    elif (untold := untold_averaging(estimate, judgement.standard_errors.scale)) is not None:
        found.append(untold)
    if not estimate.estimator.is_vector:
        found.append("reflection_free: |B| alone cannot show an inverted axis, nor a rotation of the whole sensor")
    found += residual_warnings(
        estimate.fit,
        estimate.settings,
        estimate.observations.b_nt,
        judgement.standard_errors,
        is_vector=estimate.estimator.is_vector,
        is_noise_chosen=estimate.options.noise_model == "auto",
    )
    if estimate.options.regressors != "auto":
        found += [
            f"{one.excluded}: {one.name} was asked for; auto would leave it out"
            for one in estimate.candidates
            if one.excluded is not None
        ]
    if estimate.options.regressors == "auto":
        found += _untold(estimate)
    clock = estimate.tried_clock
    if clock is not None and estimate.clock is None and _is_told(estimate):
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
