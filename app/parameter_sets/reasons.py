"""Why a verdict is what it is, in plain words, and what may mend it: a reason is one line in the registry.

A cure is a calibration of the same sessions with one option changed; nothing is stored until somebody asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from magcal_core.calibration.estimators.registry import STEP_METHODS, has_moments

Options = Mapping[str, object]
Change = Mapping[str, object] | None


@dataclass(frozen=True, slots=True)
class Cure:
    """A button: what it says, and the call that it makes (or, with GET, the page that it goes to)."""

    label: str
    method: str
    path: str
    body: Mapping[str, object] | None = None


@dataclass(frozen=True, slots=True)
class Subject:
    """The set that the reasons are of: what it was made from, and with which options."""

    parameter_set_id: str
    satellite_id: str
    session_ids: Sequence[str]
    options: Options
    housekeeping: Sequence[str] = ()
    active_id: str | None = None


@dataclass(frozen=True, slots=True)
class Plain:
    """A reason in plain words: what it means, what to do, and the cure, where one can be offered."""

    sentence: str
    advice: str
    cure: Callable[[Subject], Cure | None] = field(default=lambda _subject: None)


def _again(label: str, change: Callable[[Subject], Change]) -> Callable[[Subject], Cure | None]:
    """Return what offers the same calibration with ``change``, unless it has it already."""

    def offer(subject: Subject) -> Cure | None:
        changed = change(subject)
        if changed is None or all(subject.options.get(name) == value for name, value in changed.items()):
            return None
        given = {name: value for name, value in subject.options.items() if value is not None}
        body = {**given, **changed, "kind": "calibration", "session_ids": list(subject.session_ids)}
        return Cure(label, "POST", "/api/v1/jobs", body)

    return offer


def _first(*offers: Callable[[Subject], Cure | None]) -> Callable[[Subject], Cure | None]:
    """Return what offers the first of ``offers`` that there is."""
    return lambda subject: next((cure for offer in offers if (cure := offer(subject)) is not None), None)


def _no_clock(subject: Subject) -> Change:
    """Return the clock as an unknown, where the method can stand beside one that can have it."""
    return {"time_offset": "estimate"} if has_moments(subject.options.get("method")) else None


def _steps(subject: Subject) -> Change:
    """Return steps of the bias as unknowns, for a method that can take them."""
    return {"bias_steps": "fit"} if subject.options.get("method") in STEP_METHODS else None


def _regressors(subject: Subject) -> Change:
    """Return regressors chosen on unseen blocks, where the session has columns that may be some."""
    return {"regressors": "auto"} if subject.housekeeping else None


def _page(label: str, path: Callable[[Subject], str | None]) -> Callable[[Subject], Cure | None]:
    def offer(subject: Subject) -> Cure | None:
        found = path(subject)
        return None if found is None else Cure(label, "GET", found)

    return offer


def _comparison(subject: Subject) -> str | None:
    if subject.active_id in {None, subject.parameter_set_id}:
        return None
    return f"/compare?first={subject.active_id}&second={subject.parameter_set_id}"


TUKEY: Final = _again("Again with tukey", lambda _subject: {"robust": "tukey"})
REGRESSORS: Final = _again("With the regressors that unseen blocks support", _regressors)
NO_REGRESSORS: Final = _again(
    "Without regressors", lambda one: {"regressors": []} if one.options.get("regressors") else None
)
CLOCK: Final = _again("Look for the clock", _no_clock)
STEPS: Final = _again("With the steps fitted", _steps)
SCALAR: Final = _again("Again from |B| alone", lambda _subject: {"method": "scalar"})
ORBITS: Final = _page("Choose orbit", lambda subject: f"/satellites/{subject.satellite_id}#orbits")
MORE: Final = _page("Choose more sessions", lambda subject: f"/satellites/{subject.satellite_id}#sessions")
UPLOAD: Final = _page("See how it is read", lambda subject: f"/satellites/{subject.satellite_id}#upload-telemetry")
COMPARE: Final = _page("Compare with the set in force", _comparison)

UNCERTAIN: Final = "longer or better spread data, or several sessions in one calibration"
REASONS: Final[Mapping[str, Plain]] = {
    "observable": Plain("The data determine every parameter.", "nothing"),
    "not_observable": Plain(
        "The field was not seen from enough directions to determine every parameter.",
        "log more, and turn about the direction that the advice names", MORE,
    ),
    "weakly_observable": Plain(
        "The field was seen from few directions, so some parameters are hardly determined.",
        "log more, and turn about the direction that the advice names", MORE,
    ),
    "bias_uncertain": Plain("The bias is known only to a large share of the field.", UNCERTAIN, MORE),
    "scale_uncertain": Plain("A scale factor is known only roughly.", UNCERTAIN, MORE),
    "angle_uncertain": Plain("An angle between the axes is known only roughly.", UNCERTAIN, MORE),
    "scale_far": Plain(
        "The readings are hardly in the unit that was said.", "give the unit, or the sensor's nT per count", UPLOAD
    ),
    "field_uncertain": Plain(
        "The corrected field is not known well enough in its worst direction.", UNCERTAIN, MORE
    ),
    "rows_without_reading": Plain(
        "Half of the rows or more hold no reading, so what is left is a part of the session.",
        "look at what was sent: zeros, fill values, a stuck sensor", UPLOAD,
    ),
    "frame": Plain(
        "The reference is turned so far against the sensor that attitude or axes must be others than was said.",
        "mend the axis map or the attitude", UPLOAD,
    ),
    "large_residual": Plain(
        "After the correction, |B| still differs from the model by a large share of the field.",
        "look at the residual over time: outliers, currents, a wrong reference", _first(TUKEY, REGRESSORS),
    ),
    "poor_on_unseen_data": Plain(
        "The fit describes the data that it saw, and others much worse.",
        "fewer regressors, or data from several orbits", _first(NO_REGRESSORS, TUKEY),
    ),
    "worse_than_raw": Plain(
        "On data that it has not seen, the correction does worse than none.",
        "fewer regressors, or data from several orbits", _first(NO_REGRESSORS, TUKEY),
    ),
    "not_cross_validated": Plain(
        "A part of the data alone does not determine the parameters, so that they cannot be tried on the rest.",
        "longer data, or several sessions in one calibration", MORE,
    ),
    "many_rejected": Plain(
        "Many samples were left out or lost their weight.",
        "the session's flags say why: saturation, repeated times, spikes", TUKEY,
    ),
    "orbit_old": Plain(
        "The orbit is far from the data in time, so that the positions may be wrong.",
        "give an orbit near the data, or let the clock be an unknown", _first(CLOCK, ORBITS),
    ),
    "wrong_input_suspected": Plain(
        "The data look as if they were meant otherwise: another time scale, axes, or frame.",
        "check the telemetry's definition against what the reason names", UPLOAD,
    ),
    "differs_from_active": Plain(
        "The parameters differ from those in force by more than chance.",
        "has the sensor changed? then activate this set; else look for what was wrong with either session", COMPARE,
    ),
    "storm": Plain(
        "A magnetic storm changed the field by more than the reference knows of.",
        "give an index of those hours and calibrate again with +rc or +dst, or take a session of a quiet day", MORE,
    ),
    "bias_step": Plain(
        "The bias stepped inside the data, so that the set's own is that of neither side.",
        "find out what was switched; with the steps fitted, the set has the bias after the last one", STEPS,
    ),
    "misaligned": Plain(
        "The reference is turned against the sensor's own frame, and a vector fit puts that into the angles.",
        "correct the attitude's definition, or calibrate from |B| alone", SCALAR,
    ),
    "not_finite": Plain("A figure of the calibration is not a number.", "report it with the session"),
    "not_a_minimum": Plain("The search ended where there is no minimum.", "report it with the session", TUKEY),
    "not_converged": Plain("The search for the minimum did not end.", "report it with the session", TUKEY),
}  # fmt: skip
"""Every code that a verdict may have, in plain words."""
OTHER: Final = Plain("The verdict has this reason too.", "see the documentation of the verdict")


@dataclass(frozen=True, slots=True)
class ExplainedReason:
    """One reason of a verdict, whole: which limit it passed, what it means, and what may mend it."""

    code: str
    grade: str | None
    sentence: str
    figure: str
    advice: str
    page: str
    cure: Cure | None


def explained(reasons: Sequence[str], grades: Sequence[str], subject: Subject) -> list[ExplainedReason]:
    """Return ``reasons``, as a record has them (``code: text``), in plain words; ``grades`` of old sets are none."""
    known = [*grades, *([None] * (len(reasons) - len(grades)))]
    found = []
    for reason, grade in zip(reasons, known, strict=True):
        code, _, figure = reason.partition(": ")
        plain = REASONS.get(code, OTHER)
        cure = None if grade == "accept" else plain.cure(subject)
        page = f"/reasons#{code}"
        found.append(ExplainedReason(code, grade, plain.sentence, figure, plain.advice, page, cure))
    return found
