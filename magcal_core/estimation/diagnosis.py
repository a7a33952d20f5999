"""Step 12, diagnosis: where a fit is refused, or leaves more than noise, the cause is named and never applied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.calibration.diagnosis.wrong_input.attitude import DOUBTED_RATIO
from magcal_core.calibration.diagnosis.wrong_input.suspicions import suspicions
from magcal_core.calibration.estimators.loss import WORTH_A_LOOK
from magcal_core.calibration.reasons import Reason, Verdict
from magcal_core.data_quality import DataQuality
from magcal_core.errors import EstimationError, FrameError, MagcalError, NotObservableError, WrongInputError
from magcal_core.estimation.clock import NEAR_S
from magcal_core.estimation.estimate import Estimate
from magcal_core.estimation.judgement import Judged
from magcal_core.orbit import Orbit
from magcal_core.reference.referenced_samples import Referenced

if TYPE_CHECKING:
    from magcal_core.calibration.diagnosis.cause import Diagnosis

LONG_OFFSET_S: Final = 60.0
"""Offset, s, from which one that was taken unasked is held against other clocks: a longer one is more than a drift."""


def diagnosed(estimate: Estimate, judged: Judged, candidates: Sequence[Orbit]) -> Diagnosis | None:
    """Return the diagnosis of an estimate that is refused or leaves more than noise; None of one that is sound.

    An estimate at an offset of a minute or more that was taken unasked is not sound where another clock goes first.

    Raises
    ------
    WrongInputError
        The input has a fault beyond doubt: another orbit or clock explains the readings far better. Not of the plain
        fit of published figures, whose verdict says so.
    """
    use = estimate.loss_use
    is_sound = use.scale_nt < WORTH_A_LOOK * float(np.median(estimate.observations.b_nt))
    if is_sound and judged.judgement.verdict.grade != "refuse":
        return _other_clock(estimate, candidates)
    found = _searched(estimate.prepared.referenced, candidates)
    if found.fault is not None and found.is_certain and not estimate.options.is_plain:
        error = WrongInputError(f"{found.fault.code}: {found.fault.text}")
        error.diagnosis, error.data_quality = found.to_dict(), judged.quality.to_dict()
        raise error
    return found


def _other_clock(estimate: Estimate, candidates: Sequence[Orbit]) -> Diagnosis | None:
    """Return the diagnosis where a long offset was taken unasked and it names another clock; None where it does not.

    A satellite that comes back to nearly the same field, as after a turn of its orbit, hides hours behind minutes.
    """
    clock = estimate.clock
    if clock is None or estimate.options.time_offset != "auto" or abs(clock.offset_s) < LONG_OFFSET_S:
        return None
    found = _searched(estimate.prepared.referenced, candidates)
    fault = found.fault
    if fault is None or fault.code != "clock" or not isinstance(fault.value, float):
        return None
    return found if abs(fault.value - clock.offset_s) > NEAR_S else None


def with_cause(judged: Judged, diagnosis: Diagnosis | None) -> Judged:
    """Return ``judged`` with a verdict that names the fault of the input first, where one was found."""
    fault = None if diagnosis is None else diagnosis.fault
    if fault is None:
        return judged
    verdict = judged.judgement.verdict
    reason = Reason("wrong_input_suspected", f"{fault.code}: {fault.text}")
    verdict_with_cause = Verdict("refuse", (reason, *verdict.reasons), ("refuse", *verdict.grades))
    return replace(judged, judgement=replace(judged.judgement, verdict=verdict_with_cause))


def refused(error: MagcalError, referenced: Referenced, candidates: Sequence[Orbit]) -> MagcalError:
    """Return ``error`` with the cause first, where one was found, and with what the rows are worth."""
    # The axes or the convention that would fit, where the data show one.
    seen = suspicions(referenced.samples, quaternion_ratio=DOUBTED_RATIO)
    named = [one for one in seen if one.code == "frame_suspect"]
    if isinstance(error, FrameError):
        error = FrameError("; ".join([str(error), *(one.text for one in seen)]))
    elif isinstance(error, NotObservableError) and named:
        words = "; ".join([str(error), *(f"{one.code}: {one.text}" for one in named)])
        error = type(error)(words, error.parameters)
    diagnosis = _searched(referenced, candidates)
    cause = diagnosis.fault
    if cause is not None and isinstance(error, EstimationError):
        text = f"{cause.code}: {cause.text}; {error.message}"
        if type(error) is NotObservableError:
            error = WrongInputError(text, error.parameters)
        else:
            error.message = text
            error.args = (text,)
    error.diagnosis = diagnosis.to_dict()
    error.data_quality = DataQuality.of(referenced.samples).to_dict()
    return error


def _searched(referenced: Referenced, candidates: Sequence[Orbit]) -> Diagnosis:
    """Return what is wrong with the samples, by the orbit that most of them use and those of other objects."""
    from magcal_core.calibration.diagnosis.search import Circumstances, diagnosis_of

    orbits, used = referenced.orbits, referenced.report.orbits
    chosen = max(used, key=lambda one: int(str(one["samples"])), default=None)
    own = None if chosen is None or not referenced.has_orbit else orbits[int(str(chosen["index"]))]
    others = [orbit for orbit in [*orbits, *candidates] if orbit is not own] if own is not None else list(candidates)
    named = [(name_of(orbit), orbit) for orbit in others]
    return diagnosis_of(Circumstances(referenced.samples, own, referenced.field, named))


def name_of(orbit: Orbit) -> str:
    """Return what a person calls the object of ``orbit``: its name, else its catalogue number, else its epoch."""
    elements = getattr(orbit, "elements", None)
    name = str(getattr(elements, "name", "") or "").strip()
    number = getattr(elements, "satellite_number", None)
    parts = [part for part in (name, f"{number}" if number is not None else "") if part]
    return " ".join(parts) or f"epoch {np.datetime_as_string(orbit.epoch_utc, unit='s')}Z"
