"""Steps 10 and 14: suspicions, honest errors, cross-validation, the gate and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magcal_core.calibration.diagnosis.wrong_input.attitude import DOUBTED_RATIO, QUATERNION_RATIO
from magcal_core.calibration.diagnosis.wrong_input.suspicions import ClockFinding, Suspicion, suspicions
from magcal_core.calibration.estimators.loss import counted_weights
from magcal_core.calibration.verdict.assessment import Basis, Circumstances, Judgement, judgement_of, require_determined
from magcal_core.data_quality import DataQuality
from magcal_core.estimation.clock import far_suspicion
from magcal_core.estimation.estimate import Estimate
from magcal_core.field.external_knowledge import Storm
from magcal_core.reference.columns import TELEMETRY_POSITION
from magcal_core.reference.error_budget import ReferenceSource
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import SampleFlag

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.monitoring import ActiveSet


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What is said of an estimate: the judgement, what is suspected of the input, and what the rows are worth."""

    judgement: Judgement
    suspected: tuple[Suspicion, ...]
    quality: DataQuality


def judged(estimate: Estimate, active: ActiveSet | None) -> Judged:
    """Return what ``estimate`` is worth; ``active``: the calibration that is in force, where there is one.

    Raises
    ------
    NotObservableError
        The samples determine nothing.
    """
    referenced, trust = estimate.prepared.referenced, estimate.trust
    suspected = _suspicions(estimate)
    weights = counted_weights(estimate.fit, estimate.settings.robust)
    quality = DataQuality.of(referenced.samples, weights, referenced.samples.t_utc[estimate.usable])
    tried = estimate.tried_clock
    circumstances = Circumstances(
        referenced.age_days,
        estimate.clock is not None or (tried is not None and tried.is_bounded),
        len(referenced.samples) - len(estimate.observations) - far_count(referenced),
        quality.without_reading_share,
        tuple(f"{one.code}: {one.text}" for one in suspected),
        () if trust is None else trust.shifts,
        active,
        storm_of(referenced),
    )
    what = (estimate.estimator, estimate.observations, estimate.fit, estimate.settings)
    basis = None if trust is None else Basis(trust.plain, trust.honest, trust.full)
    judgement = judgement_of(*what, circumstances, basis)
    require_determined(estimate.fit, judgement)
    return Judged(judgement, suspected, quality)


def far_count(referenced: Referenced) -> int:
    """Return the number of samples that are too far out to be used."""
    return int(np.count_nonzero(referenced.samples.flags & np.uint16(SampleFlag.FAR)))


def source_of_reference(estimate: Estimate) -> ReferenceSource:
    """Return where the reference came from, as the error budget asks for it."""
    referenced, clock = estimate.prepared.referenced, estimate.clock
    return ReferenceSource(
        referenced.report.orbit_model,
        referenced.age_days,
        referenced.field,
        estimate.estimator.is_vector,
        None if clock is None else clock.offset_error_s,
        referenced.report.interpolation_km,
        referenced.external,
    )


def storm_of(referenced: Referenced) -> Storm | None:
    """Return the storm that the reference does not know enough of; None where it came with the telemetry."""
    stamps_ns, r_km = referenced.placed()
    return referenced.external.storm(stamps_ns, r_km) if len(stamps_ns) else None


def _suspicions(estimate: Estimate) -> tuple[Suspicion, ...]:
    """Return what the data say against their own unit, axes, attitude, frame and clock."""
    clock, referenced, trust = estimate.clock, estimate.prepared.referenced, estimate.trust
    found = None if clock is None else ClockFinding(-clock.offset_s, clock.offset_error_s)
    is_from_telemetry = referenced.report.orbit_model == TELEMETRY_POSITION
    is_doubted = trust is not None and trust.full is not None
    seen = suspicions(
        referenced.samples,
        clock=found,
        position_field=referenced.field if is_from_telemetry else None,
        quaternion_ratio=DOUBTED_RATIO if is_doubted else QUATERNION_RATIO,
    )
    far = far_suspicion(estimate)
    return seen if far is None else (*seen, far)
