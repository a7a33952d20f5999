"""What an estimate is worth: suspicions, errors of the reference, honest errors, cross-validation and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

from magcal_core.calibration.error_budget import ReferenceSource
from magcal_core.calibration.estimators.loss import counted_weights
from magcal_core.calibration.judgement import Circumstances, Judgement, judgement_of
from magcal_core.calibration.monitoring import ActiveSet
from magcal_core.calibration.reference_errors import ReferenceShift, reference_shifts
from magcal_core.calibration.suspicions import ClockFinding, Suspicion, suspicions
from magcal_core.data_quality import DataQuality
from magcal_core.estimation.estimate import Estimate
from magcal_core.reference import TELEMETRY_POSITION


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What is said of an estimate: the judgement, what is suspected of the input, and what the rows are worth."""

    judgement: Judgement
    suspected: tuple[Suspicion, ...]
    quality: DataQuality


def judged(estimate: Estimate, active: ActiveSet | None) -> Judged:
    """Return what ``estimate`` is worth; ``active``: the calibration that is in force, where there is one."""
    referenced = estimate.prepared.referenced
    suspected = _suspicions(estimate)
    quality = DataQuality.of(referenced.samples, counted_weights(estimate.fit, estimate.settings.robust))
    tried = estimate.tried_clock
    circumstances = Circumstances(
        referenced.age_days,
        estimate.clock is not None or (tried is not None and tried.is_bounded),
        len(referenced.samples) - len(estimate.observations),
        quality.without_reading_share,
        tuple(f"{one.code}: {one.text}" for one in suspected),
        _reference_shifts(estimate),
        active,
    )
    what = (estimate.estimator, estimate.observations, estimate.fit, estimate.settings)
    known = None if estimate.clock is None else estimate.clock.honest
    return Judged(judgement_of(*what, circumstances, known), suspected, quality)


def source_of_reference(estimate: Estimate) -> ReferenceSource:
    """Return where the reference came from, as the error budget asks for it."""
    referenced, clock = estimate.prepared.referenced, estimate.clock
    return ReferenceSource(
        referenced.report.orbit_model,
        referenced.age_days,
        referenced.field,
        estimate.estimator.is_vector,
        None if clock is None else clock.offset_error_s,
    )


def _suspicions(estimate: Estimate) -> tuple[Suspicion, ...]:
    """Return what the data say against their own unit, axes, attitude, frame and clock."""
    clock, referenced = estimate.clock, estimate.prepared.referenced
    found = None if clock is None else ClockFinding(-clock.offset_s, clock.offset_error_s)
    is_from_telemetry = referenced.report.orbit_model == TELEMETRY_POSITION
    return suspicions(referenced.samples, clock=found, position_field=referenced.field if is_from_telemetry else None)


def _reference_shifts(estimate: Estimate) -> tuple[ReferenceShift, ...]:
    used = estimate.prepared.referenced.samples.take(estimate.usable)
    weighed = replace(estimate.observations, weights=estimate.fit.weights)
    return reference_shifts(used, weighed, estimate.fit.parameters, source_of_reference(estimate))
