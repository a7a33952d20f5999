"""What a fit is worth: honest errors, cross-validation, observability and the verdict on all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.corrections import lengths
from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations, corrected_nt
from magcal_core.calibration.motion import advice, motion_words, vector_weak_words, weak_words
from magcal_core.calibration.observability import (
    condition_number,
    scalar_information,
    sphere_coverage,
    vector_information,
)
from magcal_core.calibration.reference_errors import ReferenceShift
from magcal_core.calibration.result import Observability, Parameters, ResidualStatistics, Verdict
from magcal_core.calibration.selection import held_out_residuals_nt, rms_nt
from magcal_core.calibration.uncertainty import HonestCovariance, honest_covariance
from magcal_core.calibration.verdict import Evidence, judge
from magcal_core.calibration.weights import robust_sigma
from magcal_core.sensor import matrix_of_parameters

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What the verdict must know that is not in the fit: the orbit's age, clock, samples left out, suspicions, and what
    errors of the reference do to the parameters.
    """

    orbit_age_days: float
    has_time_offset: bool
    left_out: int
    suspicions: tuple[str, ...] = ()
    reference: tuple[ReferenceShift, ...] = ()


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


def judgement_of(
    estimator: Estimator, observations: Observations, fit: Fit, settings: FitSettings, circumstances: Circumstances
) -> Judgement:
    """Return what ``fit`` is worth."""
    seen = honest_covariance(fit.blocks, fit.covariance, len(observations))
    honest = replace(seen, covariance=_with_reference(seen.covariance, circumstances.reference))
    names = len(fit.parameters.names)
    errors = np.sqrt(np.diag(honest.covariance))
    errors = np.concatenate([errors, np.zeros(max(0, names - errors.size))])[:names]
    standard_errors = fit.parameters.with_vector(errors)
    before, after = statistics_of(observations, fit, estimator.is_vector)
    # The clock stays where all data put it: one number, and the held-out reference is taken at it.
    still = replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)
    held_out = held_out_residuals_nt(estimator, still, settings, fit)
    unseen = None if held_out is None else rms_nt(held_out, fit.weights)
    used = fit.weights > 0
    observability, directions = observability_of(observations.take(used), fit, estimator.is_vector)
    lost = circumstances.left_out + int(np.count_nonzero(~used))
    evidence = Evidence(
        index=observability.index,
        parameters=fit.parameters,
        standard_errors=_at_mean(fit, standard_errors, observations, honest),
        mean_field_nt=float(observations.b_nt.mean()),
        field_variation=_variation(observations, fit),
        before=before,
        after=after,
        cross_validated_rms_nt=unseen,
        rejected_share=lost / max(len(observations) + circumstances.left_out, 1),
        is_converged=fit.status == "converged",
        is_vector=estimator.is_vector,
        is_plain=settings.robust == "none" and settings.noise_model == "none" and not fit.clock.size,
        orbit_age_days=circumstances.orbit_age_days,
        has_time_offset=circumstances.has_time_offset,
        suspicions=circumstances.suspicions,
        misaligned_deg=_misaligned_deg(fit),
    )
    return Judgement(
        honest,
        circumstances.reference,
        standard_errors,
        before,
        after,
        unseen,
        observability,
        advice(observability.index, observability.sphere_coverage, directions, observations.b_nt),
        judge(evidence),
        motion_words(directions),
    )


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
    return float(length.std() / length.mean())


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
            carry[axis, names.index(f"regressors.{name}[{axis}]")] = float(column.mean())
    covariance = honest.covariance[: len(names), : len(names)]
    return errors.with_vector(np.sqrt(np.abs(np.diag(carry @ covariance @ carry.T))))


def statistics_of(
    observations: Observations, fit: Fit, is_vector: bool
) -> tuple[ResidualStatistics, ResidualStatistics]:
    """Return the residual statistics of the raw and of the corrected readings, over the samples that have weight."""
    if is_vector:
        raw = observations.h_nt - observations.require_vector()
    else:
        raw = lengths(observations.h_nt) - observations.b_nt
    used = fit.weights > 0
    b_nt = observations.b_nt[used]
    return residual_statistics(raw[used], b_nt), residual_statistics(fit.residuals_nt[used], b_nt)


def residual_statistics(residuals: Floats, b_nt: Floats) -> ResidualStatistics:
    """Return the statistics of ``residuals``, shape (n,) or (n, 3), nT, over all components."""
    relative = np.abs(residuals) / (b_nt[:, None] if residuals.ndim == 2 else b_nt)
    return ResidualStatistics(
        mean_nt=float(residuals.mean()),
        std_nt=float(residuals.std()),
        rms_nt=float(np.sqrt(np.mean(residuals**2))),
        max_abs_nt=float(np.abs(residuals).max()),
        max_percent=float(100.0 * relative.max()),
    )


def observability_of(observations: Observations, fit: Fit, is_vector: bool) -> tuple[Observability, Floats]:
    """Return how well the samples determine the parameters, and the directions of the field in the sensor's frame."""
    parameters = fit.parameters
    matrix = matrix_of_parameters(parameters.scale, np.deg2rad(parameters.nonorthogonality_deg))
    normal = fit.blocks.normals.sum(axis=0)
    inverse = np.linalg.pinv(fit.blocks.to_parameters)
    condition = condition_number((inverse.T @ normal @ inverse)[:9, :9])
    if is_vector:
        b_nt = observations.require_vector()
        directions = b_nt / observations.b_nt[:, None]
        noise_nt = robust_sigma(fit.residuals_nt[fit.weights > 0])
        index, spreads, axes = vector_information(b_nt, noise_nt)
        words = vector_weak_words(index, spreads, axes)
    else:
        x_nt = corrected_nt(observations, parameters)
        length = lengths(x_nt)
        directions = x_nt / length[:, None]
        gain = lengths(directions @ np.linalg.inv(matrix))
        information = scalar_information(x_nt, matrix, robust_sigma((length - observations.b_nt) / gain))
        index = information.index
        words = weak_words(information, directions)
    coverage = sphere_coverage(directions)
    return Observability(index, condition, coverage, words), directions


def extras_of(judgement: Judgement, parameters: Parameters, samples: int) -> Mapping[str, object]:
    """Return what the record carries of a judgement beside its own fields."""
    return {
        "uncertainty": {
            "method": "lowest frequencies of the scores, correlations by blocks, Student's t contained",
            "blocks": judgement.honest.blocks,
            "block_samples": min(judgement.honest.block_samples, samples),
            "reference": [one.to_dict(parameters) for one in judgement.reference],
        },
        "advice": list(judgement.advice),
        "motion": judgement.motion,
    }
