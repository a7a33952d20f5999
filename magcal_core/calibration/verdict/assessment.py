"""What a fit is worth: honest errors, cross-validation, observability and the verdict on all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.loss import counted_weights
from magcal_core.calibration.estimators.scalar_kernel import geometric_residuals_nt
from magcal_core.calibration.observability.advice import advice, motion_words, vector_weak_words, weak_words
from magcal_core.calibration.observability.information import (
    ENOUGH,
    PARAMETER_NAMES,
    SHORT_NAMES,
    UNOBSERVABLE_BELOW,
    Observability,
    ScalarInformation,
    SphereMotion,
    condition_number,
    scalar_information,
    sphere_motion,
    taking_part,
    vector_information,
)
from magcal_core.calibration.reasons import Verdict
from magcal_core.calibration.residuals import ResidualStatistics, residual_statistics
from magcal_core.calibration.terms.full_matrix import FullMatrix, unseen_rms_nt
from magcal_core.calibration.uncertainty.consider_errors import ReferenceShift
from magcal_core.calibration.uncertainty.cross_validation import held_out_residuals_nt, rms_nt
from magcal_core.calibration.uncertainty.field_error import FieldError, field_error, field_error_of_matrix
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance, covered_s, honest_covariance
from magcal_core.calibration.verdict.verdict import DETERMINED, NOISE_ALONE, Evidence, Turn, judge
from magcal_core.errors import NotObservableError
from magcal_core.field.external_knowledge import Storm
from magcal_core.numerics.robust import robust_sigma
from magcal_core.numerics.vectors import lengths
from magcal_core.observations import Observations
from magcal_core.sensor.correction import correct, readings_without
from magcal_core.sensor.model import inverse_lower
from magcal_core.sensor.parameterisation import matrix_jacobian
from magcal_core.sensor.parameters import Parameters

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.monitoring import ActiveSet
    from magcal_core.calibration.verdict.agreement import Agreement


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What the verdict must know that is not in the fit: the orbit's age, clock, samples left out, the share of rows
    that hold no reading, suspicions, what errors of the reference do to the parameters, the calibration in force
    before, and a storm.
    """

    orbit_age_days: float
    has_time_offset: bool
    left_out: int
    without_reading_share: float = 0.0
    suspicions: tuple[str, ...] = ()
    reference: tuple[ReferenceShift, ...] = ()
    active: ActiveSet | None = None
    storm: Storm | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """What a fit was made of and what stands beside it, where there is more than the fit itself.

    Attributes
    ----------
    plain : Fit, optional
        The fit before locked errors moved it: what cross-validation begins at.
    honest : HonestCovariance, optional
        Its covariance, where that is known already; errors of the reference are not in it.
    full : FullMatrix, optional
        All nine elements of T, where they are the result.
    """

    plain: Fit | None = None
    honest: HonestCovariance | None = None
    full: FullMatrix | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Everything that is said of a fit beside its numbers."""

    honest: HonestCovariance
    reference: tuple[ReferenceShift, ...]
    standard_errors: Parameters
    before: ResidualStatistics
    after: ResidualStatistics
    cross_validated_rms_nt: float | None
    observability: Observability
    advice: tuple[str, ...]
    verdict: Verdict
    motion: str
    agreement: Agreement | None
    field_error: FieldError
    information: ScalarInformation | None


def judgement_of(  # noqa: PLR0917
    estimator: Estimator,
    observations: Observations,
    fit: Fit,
    settings: FitSettings,
    circumstances: Circumstances,
    basis: Basis | None = None,
) -> Judgement:
    """Return what ``fit`` is worth; ``basis``: what stands beside it."""
    known = Basis() if basis is None else basis
    duration_s, seen, full = covered_s(observations.t_s), known.honest, known.full
    if seen is None:
        seen = honest_covariance(fit.blocks, fit.covariance, len(observations), duration_s)
    honest = replace(seen, covariance=_with_reference(seen.covariance, circumstances.reference))
    if full is not None:
        honest = replace(honest, covariance=full.parameter_covariance)
    names = len(fit.parameters.names)
    errors = np.sqrt(np.diag(honest.covariance))
    errors = np.concatenate([errors, np.zeros(max(0, names - errors.size))])[:names]
    standard_errors = fit.parameters.with_vector(errors)
    counted = replace(fit, weights=counted_weights(fit, settings.robust))
    before, after = statistics_of(observations, counted, estimator.is_vector)
    if full is None:
        near = fit if known.plain is None else known.plain
        unseen = _unseen_rms_nt(estimator, observations, settings, near, counted.weights)
    else:
        unseen = unseen_rms_nt(observations, counted, full)
    observability, motion, information = observability_of(observations, counted, estimator.is_vector)
    mean_field_nt, active = float(observations.b_nt.mean()), circumstances.active
    agreement = None
    if active is not None:
        from magcal_core.calibration.verdict.agreement import agreement_with

        agreement = agreement_with(
            active, fit.parameters, honest.covariance, mean_field_nt, is_vector=estimator.is_vector
        )
    lost = int(np.count_nonzero(~(counted.weights > 0)))
    field = _field_error(fit, observations, honest, full)
    evidence = Evidence(
        index=observability.index,
        field_error=field,
        parameters=fit.parameters,
        standard_errors=_at_mean(fit, standard_errors, observations, honest),
        mean_field_nt=mean_field_nt,
        field_variation=_variation(observations, fit),
        before=before,
        after=after,
        cross_validated_rms_nt=unseen,
        rejected_share=lost / max(len(observations), 1),
        without_reading_share=circumstances.without_reading_share,
        is_converged=fit.status == "converged",
        is_vector=estimator.is_vector,
        is_plain=_is_plain(fit, settings, known),
        orbit_age_days=circumstances.orbit_age_days,
        has_time_offset=circumstances.has_time_offset,
        suspicions=circumstances.suspicions,
        turn=_turn_of_reference(fit) if full is None else Turn(full.rotation_deg, full.rotation_error_deg),
        agreement=agreement,
        storm=None if circumstances.storm is None or not circumstances.storm.is_weak else circumstances.storm.text,
    )
    return Judgement(
        honest,
        circumstances.reference,
        standard_errors,
        before,
        after,
        unseen,
        observability,
        advice(observability.index, motion, observations.b_nt, duration_s),
        judge(evidence),
        motion_words(motion),
        agreement,
        field,
        information,
    )


def _is_plain(fit: Fit, settings: FitSettings, basis: Basis) -> bool:
    """Return whether the fit is at the minimum of the plain sum of squares, and nowhere else."""
    is_moved = basis.plain is not None and basis.plain is not fit
    return settings.robust == "none" and settings.noise_model == "none" and not fit.clock.size and not is_moved


def _field_error(fit: Fit, observations: Observations, honest: HonestCovariance, full: FullMatrix | None) -> FieldError:
    """Return the error of the corrected field in its worst direction, the bias taken where the regressors' mean is."""
    if full is not None:
        return field_error_of_matrix(full.matrix, full.covariance)
    return field_error(fit.parameters, _covariance_at_mean(fit, observations, honest))


def require_determined(fit: Fit, judgement: Judgement) -> None:
    """Refuse a fit that determines nothing: no number is better than one that says nothing.

    Raises
    ------
    NotObservableError
        The search did not end, no sample is left over, the covariance is none, the index that noise cannot feign is
        below `NOISE_ALONE`, or the corrected field is not known to its own size.
    """
    found, information = judgement.field_error, judgement.information
    covariance = judgement.honest.covariance
    is_safe = information is None or information.noise_safe_index >= NOISE_ALONE
    is_positive = bool(np.isfinite(covariance).all()) and bool(np.all(np.diag(covariance) > 0.0))
    if fit.status == "converged" and is_positive and is_safe and found.share <= DETERMINED:
        return
    named = tuple(range(9))
    if information is not None:
        below = information.weak[information.ratios < UNOBSERVABLE_BELOW]
        named = taking_part(below) or taking_part(information.weak[:1]) or named
    letters = ", ".join(SHORT_NAMES[i] for i in named)
    seen = judgement.observability
    why = f"observability index {seen.index:.2g}, needed {UNOBSERVABLE_BELOW:g}"
    if fit.status != "converged":
        why += "; the search for the minimum did not end"
    raise NotObservableError(
        f"the samples do not determine {letters}: {why}; condition number {seen.condition_number:.3g}; the corrected "
        f"field is known to {found.share:.2g} of it, limit {DETERMINED:g}",
        [PARAMETER_NAMES[i] for i in named],
    )


def matrix_standard_errors(parameters: Parameters, judgement: Judgement, full: FullMatrix | None) -> Floats:
    """Return the standard errors of the elements of T, shape (3, 3): zero above the diagonal but for a full one."""
    if full is not None:
        return full.standard_errors
    matrix = parameters.matrix
    jacobian = matrix_jacobian(matrix)
    jacobian[3:] = np.rad2deg(jacobian[3:])
    back = np.linalg.inv(jacobian)
    found = np.zeros((3, 3))
    found[np.tril_indices(3)] = np.sqrt(np.diag(back @ judgement.honest.covariance[3:9, 3:9] @ back.T))
    return found


def _unseen_rms_nt(
    estimator: Estimator, observations: Observations, settings: FitSettings, fit: Fit, counted: Floats
) -> float | None:
    """Return the RMS residual, nT, of blocks that a fit has not seen; None where the rest does not determine it.

    ``counted``: weights of the samples, zero where they do not count.
    """
    # The clock stays where all data put it: one number, and the held-out reference is taken at it.
    still = replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)
    held_out = held_out_residuals_nt(estimator, still, settings, fit)
    return None if held_out is None else rms_nt(held_out, counted)


def _with_reference(covariance: Floats, shifts: Sequence[ReferenceShift]) -> Floats:
    """Return the covariance with that of the reference's errors, which leave no trace in the residuals."""
    total = covariance.copy()
    for one in shifts:
        size = len(one.shift)
        total[:size, :size] += np.outer(one.shift, one.shift)
    return total


def _variation(observations: Observations, fit: Fit) -> float:
    """Return the coefficient of variation of the corrected |B|, noise and all; of the reference's for a vector fit."""
    length = observations.b_nt + fit.residuals_nt if fit.residuals_nt.ndim == 1 else observations.b_nt
    mean = float(length.mean())
    away = length - mean
    return float(np.sqrt(away @ away / away.size)) / mean


def _turn_of_reference(fit: Fit) -> Turn | None:
    """Return a turn that the method's test finds and its result does not have: all of it is then an error."""
    found = fit.full_matrix
    return None if found is None or not found.is_misaligned else Turn(found.angle_deg, found.angle_deg)


def _at_mean(fit: Fit, errors: Parameters, observations: Observations, honest: HonestCovariance) -> Parameters:
    """Return the standard errors with that of the bias taken at the regressors' mean, where the data are."""
    if not observations.regressors:
        return errors
    return errors.with_vector(np.sqrt(np.abs(np.diag(_covariance_at_mean(fit, observations, honest)))))


def _covariance_at_mean(fit: Fit, observations: Observations, honest: HonestCovariance) -> Floats:
    """Return the covariance, shape (p, p), with the bias taken at the regressors' mean."""
    names = fit.parameters.names
    covariance = np.zeros((len(names), len(names)))
    known = min(len(names), len(honest.covariance))
    covariance[:known, :known] = honest.covariance[:known, :known]
    if not observations.regressors:
        return covariance
    carry = np.eye(len(names))
    for name, column in observations.regressors.items():
        for axis in range(3):
            mean = column[:, axis].mean() if column.ndim == 2 else column.mean()
            carry[axis, names.index(f"regressors.{name}[{axis}]")] = float(mean)
    return np.asarray(carry @ covariance @ carry.T)


def statistics_of(
    observations: Observations, fit: Fit, is_vector: bool
) -> tuple[ResidualStatistics, ResidualStatistics]:
    """Return the residual statistics of the raw and of the corrected readings, over the samples that have weight."""
    if is_vector:
        raw = observations.h_nt - observations.require_vector()
    else:
        raw = lengths(observations.h_nt)
        raw -= observations.b_nt
    before = residual_statistics(raw, observations.b_nt, fit.weights)
    return before, residual_statistics(fit.residuals_nt, observations.b_nt, fit.weights)


def observability_of(
    observations: Observations, fit: Fit, is_vector: bool
) -> tuple[Observability, SphereMotion, ScalarInformation | None]:
    """Return how well the samples that have weight determine the parameters, and how the field moved over them.

    The last is what |B| alone determines; None where components count.
    """
    information = None
    normal = fit.blocks.normals.sum(axis=0)
    inverse = np.linalg.pinv(fit.blocks.to_parameters)
    condition = condition_number((inverse.T @ normal @ inverse)[:9, :9])
    if is_vector:
        used = fit.weights > 0
        base_nt = observations.require_vector()
        motion = sphere_motion(base_nt, fit.weights, np.zeros(3), np.eye(3))
        noise_nt = robust_sigma(_with_weight(fit.residuals_nt, used))
        index, spreads, axes = vector_information(_with_weight(base_nt, used), noise_nt)
        words = vector_weak_words(index, spreads, axes)
    else:
        motion, information = _scalar_information(observations, fit)
        index = information.index
        words = weak_words(information, motion)
    return Observability(index, condition, motion.coverage, words), motion, information


def _with_weight(column: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return the rows of ``column`` that are ``used``; where all are, the column itself."""
    return column if used.all() else column[used]


def _scalar_information(observations: Observations, fit: Fit) -> tuple[SphereMotion, ScalarInformation]:
    """Return how the field moved over the samples that have weight, and what they determine; nothing is kept of all."""
    parameters = fit.parameters
    matrix = parameters.matrix
    reading = readings_without(observations.regressors, observations.h_nt, parameters)
    lower, used = inverse_lower(matrix), fit.weights > 0
    motion = sphere_motion(reading, fit.weights, parameters.bias_nt, lower)
    theta = np.concatenate([lower[np.tril_indices(3)], lower @ parameters.bias_nt])
    geometric_nt = geometric_residuals_nt(reading, observations.b_nt, theta)
    noise_nt = robust_sigma(_with_weight(geometric_nt, used))
    step = max(1, int(np.count_nonzero(used)) // ENOUGH)
    few = reading[::step] if used.all() else reading[np.flatnonzero(used)[::step]]
    return motion, scalar_information(correct(few, parameters.bias_nt, lower), matrix, noise_nt)


def extras_of(judgement: Judgement, parameters: Parameters, samples: int) -> Mapping[str, object]:
    """Return what the record carries of a judgement beside its own fields."""
    compared = {} if judgement.agreement is None else {"agreement": judgement.agreement.to_dict()}
    return {
        **compared,
        "uncertainty": {
            "method": "posterior correlations, lowest frequencies of the scores, Student's t contained",
            "blocks": judgement.honest.blocks,
            "block_samples": min(judgement.honest.block_samples, samples),
            "longest_memory_s": judgement.honest.longest_memory_s,
            "reference": [one.to_dict(parameters) for one in judgement.reference],
        },
        "advice": list(judgement.advice),
        "motion": judgement.motion,
    }
