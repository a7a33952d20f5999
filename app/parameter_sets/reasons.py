"""Why a verdict is what it is, in plain words, and what may mend it: a reason is one line in the registry.

A cure is a calibration of the same sessions with one option changed; nothing is stored until somebody asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from typing import Final

from app.http.schemas import day_text, utc_text
from magcal_core.calibration.estimators.registry import has_moments, step_methods

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
    time_scale: str | None = None
    """Scale that the clock seems to keep, where the record suspects one."""
    stretches: Sequence[tuple[datetime, datetime]] = ()
    """Where the loss rejects most rows."""
    has_outliers: bool = False
    """Whether the record warns of residuals that no loss has put aside."""
    nearer_orbit: datetime | None = None
    """Epoch of an orbit that serves the data better than what the set was made with."""
    figure: str = ""
    """Of the reason that is explained."""


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
        return _job(label, subject, changed)

    return offer


def _job(label: str, subject: Subject, changed: Mapping[str, object]) -> Cure:
    """Return the same calibration with ``changed``."""
    given = {name: value for name, value in subject.options.items() if value is not None}
    body = {**given, **changed, "kind": "calibration", "session_ids": list(subject.session_ids)}
    return Cure(label, "POST", "/api/v1/jobs", body)


def _first(*offers: Callable[[Subject], Cure | None]) -> Callable[[Subject], Cure | None]:
    """Return what offers the first of ``offers`` that there is."""
    return lambda subject: next((cure for offer in offers if (cure := offer(subject)) is not None), None)


def _no_clock(subject: Subject) -> Change:
    """Return the clock as an unknown, where the method can stand beside one that can have it."""
    return {"time_offset": "estimate"} if has_moments(subject.options.get("method")) else None


def _steps(subject: Subject) -> Change:
    """Return steps of the bias as unknowns, for a method that can take them."""
    return {"bias_steps": "fit"} if subject.options.get("method") in step_methods() else None


def _regressors(subject: Subject) -> Change:
    """Return regressors chosen on unseen blocks, where the session has columns that may be some."""
    return {"regressors": "auto"} if subject.housekeeping else None


def _leave_out(subject: Subject) -> Cure | None:
    """Return the calibration without the stretches of time whose rows the loss rejects, where there are any."""
    spans = [_rounded(*one) for one in sorted(subject.stretches)]
    if not spans:
        return None
    known = subject.options.get("without")
    texts = [f"{utc_text(begin)}/{utc_text(end)}" for begin, end in spans]
    label = "Leave out " + " and ".join(_clock_span(begin, end) for begin, end in spans)
    return _job(label, subject, {"without": [*(known if isinstance(known, list) else []), *texts]})


def _rounded(begin: datetime, end: datetime) -> tuple[datetime, datetime]:
    """Return the span to the whole minute about it, a short one to the whole second."""
    unit = timedelta(minutes=1) if end - begin >= timedelta(minutes=10) else timedelta(seconds=1)
    whole = datetime(1970, 1, 1, tzinfo=begin.tzinfo)
    return begin - (begin - whole) % unit, end + (whole - end) % unit


def _clock_span(begin: datetime, end: datetime) -> str:
    form = "%H:%M" if begin.second == end.second == 0 else "%H:%M:%S"
    last = f"{end:{form}}" if end.date() == begin.date() else f"{end:{form}} of {day_text(end)}"
    return f"{begin:{form}}-{last}"


def _as_time_scale(subject: Subject) -> Cure | None:
    """Return the calibration with times of the scale that the clock seems to keep, where the reason is about that."""
    scale = subject.time_scale
    if scale is None or not subject.figure.startswith(OF_THE_CLOCK) or subject.options.get("time_scale") == scale:
        return None
    return _job(f"As {scale.upper()} time", subject, {"time_scale": scale})


def _nearer_orbit(subject: Subject) -> Cure | None:
    """Return the same calibration again, where an orbit has come that serves the data better."""
    if subject.nearer_orbit is None:
        return None
    return _job(f"Use the orbit of {day_text(subject.nearer_orbit)}", subject, {})


def _outliers(subject: Subject) -> Cure | None:
    """Return the calibration under a loss that puts outliers aside, where there are some."""
    return TUKEY(subject) if subject.has_outliers else None


def _untried_columns(subject: Subject) -> Cure | None:
    """Return the calibration with regressors, where no column was tried."""
    return None if subject.options.get("regressors") else REGRESSORS(subject)


def _page(label: str, path: Callable[[Subject], str | None]) -> Callable[[Subject], Cure | None]:
    def offer(subject: Subject) -> Cure | None:
        found = path(subject)
        return None if found is None else Cure(label, "GET", found)

    return offer


def _comparison(subject: Subject) -> str | None:
    if subject.active_id in {None, subject.parameter_set_id}:
        return None
    return f"/compare?first={subject.active_id}&second={subject.parameter_set_id}"


OF_THE_CLOCK: Final = ("time_scale_suspect", "clock")
"""How the text of a reason begins that is about the clock."""
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
        "The corrected field is not known well enough in its worst direction.",
        UNCERTAIN, _first(_outliers, _untried_columns, MORE),
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
        "look at the residual over time: outliers, currents, a wrong reference",
        _first(_leave_out, TUKEY, REGRESSORS),
    ),
    "poor_on_unseen_data": Plain(
        "The fit describes the data that it saw, and others much worse.",
        "fewer regressors, or data from several orbits", _first(NO_REGRESSORS, _leave_out, TUKEY),
    ),
    "worse_than_raw": Plain(
        "On data that it has not seen, the correction does worse than none.",
        "fewer regressors, or data from several orbits", _first(NO_REGRESSORS, _leave_out, TUKEY),
    ),
    "not_cross_validated": Plain(
        "A part of the data alone does not determine the parameters, so that they cannot be tried on the rest.",
        "longer data, or several sessions in one calibration", MORE,
    ),
    "many_rejected": Plain(
        "Many samples were left out or lost their weight.",
        "the session's flags say why: saturation, repeated times, spikes", _first(_leave_out, TUKEY),
    ),
    "orbit_old": Plain(
        "The orbit is far from the data in time, so that the positions may be wrong.",
        "give an orbit near the data, or let the clock be an unknown", _first(_nearer_orbit, CLOCK, ORBITS),
    ),
    "wrong_input_suspected": Plain(
        "The data look as if they were meant otherwise: another time scale, axes, or frame.",
        "check the telemetry's definition against what the reason names; for telemetry to come, declare it on the "
        "magnetometer",
        _first(_as_time_scale, UPLOAD),
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
        cure = None if grade == "accept" else plain.cure(replace(subject, figure=figure))
        page = f"/reasons#{code}"
        found.append(ExplainedReason(code, grade, plain.sentence, figure, plain.advice, page, cure))
    return found
