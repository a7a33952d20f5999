"""What a fit is worth: honest errors, cross-validation, observability and the verdict on all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.agreement import Agreement, agreement_with
from magcal_core.calibration.corrections import correct, lengths, statistics
from magcal_core.calibration.estimators.loss import counted_weights
from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations, readings_without
from magcal_core.calibration.kernels import residuals
from magcal_core.calibration.monitoring import ActiveSet
from magcal_core.calibration.motion import advice, motion_words, vector_weak_words, weak_words
from magcal_core.calibration.observability import (
    ENOUGH,
    ScalarInformation,
    SphereMotion,
    condition_number,
    scalar_information,
    sphere_motion,
    vector_information,
)
from magcal_core.calibration.reference_errors import ReferenceShift
from magcal_core.calibration.result import Observability, Parameters, ResidualStatistics, Verdict
from magcal_core.calibration.selection import held_out_residuals_nt, rms_nt
from magcal_core.calibration.uncertainty import HonestCovariance, covered_s, honest_covariance
from magcal_core.calibration.verdict import Evidence, judge
from magcal_core.calibration.weights import robust_sigma
from magcal_core.sensor import inverse_lower, matrix_of_parameters

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What the verdict must know that is not in the fit: the orbit's age, clock, samples left out, the share of rows
    that hold no reading, suspicions, what errors of the reference do to the parameters, and the calibration in force
    before.
    """

    orbit_age_days: float
    has_time_offset: bool
    left_out: int
    without_reading_share: float = 0.0
    suspicions: tuple[str, ...] = ()
    reference: tuple[ReferenceShift, ...] = ()
    active: ActiveSet | None = None


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


def judgement_of(  # noqa: PLR0917
    estimator: Estimator,
    observations: Observations,
    fit: Fit,
    settings: FitSettings,
    circumstances: Circumstances,
    known: HonestCovariance | None = None,
) -> Judgement:
    """Return what ``fit`` is worth; ``known``: its honest covariance, where that is known already."""
    duration_s = covered_s(observations.t_s)
    seen = honest_covariance(fit.blocks, fit.covariance, len(observations), duration_s) if known is None else known
    honest = replace(seen, covariance=_with_reference(seen.covariance, circumstances.reference))
    names = len(fit.parameters.names)
    errors = np.sqrt(np.diag(honest.covariance))
    errors = np.concatenate([errors, np.zeros(max(0, names - errors.size))])[:names]
    standard_errors = fit.parameters.with_vector(errors)
    counted = replace(fit, weights=counted_weights(fit, settings.robust))
    before, after = statistics_of(observations, counted, estimator.is_vector)
    unseen = _unseen_rms_nt(estimator, observations, settings, fit, counted.weights)
    observability, motion = observability_of(observations, counted, estimator.is_vector)
    mean_field_nt, active = float(observations.b_nt.mean()), circumstances.active
    agreement = None
    if active is not None:
        agreement = agreement_with(
            active, fit.parameters, honest.covariance, mean_field_nt, is_vector=estimator.is_vector
        )
    lost = int(np.count_nonzero(~(counted.weights > 0)))
    evidence = Evidence(
        index=observability.index,
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
        is_plain=settings.robust == "none" and settings.noise_model == "none" and not fit.clock.size,
        orbit_age_days=circumstances.orbit_age_days,
        has_time_offset=circumstances.has_time_offset,
        suspicions=circumstances.suspicions,
        misaligned_deg=_misaligned_deg(fit),
        agreement=agreement,
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
    )


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


def _misaligned_deg(fit: Fit) -> float:
    """Return the turn, deg, that the fit warns of; 0 where it does not."""
    full = fit.extras.get("full_matrix")
    if not isinstance(full, Mapping) or not any(warning.startswith("misaligned") for warning in fit.warnings):
        return 0.0
    return float(full["rotation_deg"])


def _at_mean(fit: Fit, errors: Parameters, observations: Observations, honest: HonestCovariance) -> Parameters:
    """Return the standard errors with that of the bias taken at the regressors' mean, where the data are."""
    if not observations.regressors:
        return errors
    names = fit.parameters.names
    carry = np.eye(len(names))
    for name, column in observations.regressors.items():
        for axis in range(3):
            mean = column[:, axis].mean() if column.ndim == 2 else column.mean()
            carry[axis, names.index(f"regressors.{name}[{axis}]")] = float(mean)
    covariance = honest.covariance[: len(names), : len(names)]
    return errors.with_vector(np.sqrt(np.abs(np.diag(carry @ covariance @ carry.T))))


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


def residual_statistics(residuals_nt: Floats, b_nt: Floats, weights: Floats) -> ResidualStatistics:
    """Return the statistics of residuals, shape (n,) or (n, 3), nT, over all components of samples that have weight."""
    table = np.require(residuals_nt.reshape(len(b_nt), -1), np.float64, ["C", "W"])
    mean, spread, largest, share = statistics(table, b_nt, np.require(weights, np.float64, ["C", "W"]))
    return ResidualStatistics(
        mean, float(np.sqrt(spread)), float(np.hypot(mean, np.sqrt(spread))), largest, 100 * share
    )


def observability_of(observations: Observations, fit: Fit, is_vector: bool) -> tuple[Observability, SphereMotion]:
    """Return how well the samples that have weight determine the parameters, and how the field moved over them."""
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
    return Observability(index, condition, motion.coverage, words), motion


def _with_weight(column: Floats, used: NDArray[np.bool_]) -> Floats:
    """Return the rows of ``column`` that are ``used``; where all are, the column itself."""
    return column if used.all() else column[used]


def _scalar_information(observations: Observations, fit: Fit) -> tuple[SphereMotion, ScalarInformation]:
    """Return how the field moved over the samples that have weight, and what they determine; nothing is kept of all."""
    parameters = fit.parameters
    matrix = matrix_of_parameters(parameters.scale, np.deg2rad(parameters.nonorthogonality_deg))
    reading = readings_without(observations.regressors, observations.h_nt, parameters)
    lower, used = inverse_lower(matrix), fit.weights > 0
    motion = sphere_motion(reading, fit.weights, parameters.bias_nt, lower)
    geometric_nt, none = np.empty(len(used)), np.zeros((len(used), 0))
    theta = np.concatenate([lower[np.tril_indices(3)], lower @ parameters.bias_nt])
    residuals(np.require(reading, np.float64, ["C", "W"]), observations.b_nt, none, none, theta, 0.0, geometric_nt)
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
            "method": "lowest frequencies of the scores, correlations by blocks, Student's t contained",
            "blocks": judgement.honest.blocks,
            "block_samples": min(judgement.honest.block_samples, samples),
            "longest_memory_s": judgement.honest.longest_memory_s,
            "reference": [one.to_dict(parameters) for one in judgement.reference],
        },
        "advice": list(judgement.advice),
        "motion": judgement.motion,
    }
