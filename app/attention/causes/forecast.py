"""The set in force is past what the trend of its magnetometer's sets vouches for."""

from __future__ import annotations

from datetime import datetime, timedelta

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import INSTANT, activate, age, age_unchanged_for, calibrate, satellite_page
from app.attention.situation import LifeFacts, Situation
from app.http.schemas import day_text


class ForecastOut:
    """The life of the set in force has ended; a later session that agrees with it is the better witness."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return when it ended; the button activates a newer set, calibrates newer data, or goes to the upload."""
        life, active = situation.life, situation.active
        if life is None or active is None or life.parameter_set_id != active.id:
            return None
        if life.until is None or now <= life.until:
            return None
        is_borne_out = _agrees_since(situation, life.until)
        severity = Severity.WATCH if life.is_capped or is_borne_out else Severity.ACT
        action, what_to_do = _cure(situation)
        links = {"parameter_set_id": active.id}
        if situation.session is not None:
            links["session_id"] = situation.session.id
        witness = "; the newest session still agrees with it" if is_borne_out else ""
        text = f"{_told(life, life.until, now)}{witness}; {what_to_do}"
        return Finding(severity, text, life.until, f"{active.id} {day_text(life.until)}", links, action)

    def unchanged_for(self, situation: Situation, now: datetime) -> timedelta | None:
        """Return for how long the life goes on, or its age is said the same way."""
        until = None if situation.life is None else situation.life.until
        if until is None:
            return None
        return max(until - now, INSTANT) if now <= until else age_unchanged_for(until, now)


def _told(life: LifeFacts, until: datetime, now: datetime) -> str:
    assured = f"the trend vouched for it to within {100.0 * life.share:g} % until"
    when = f"{day_text(until)}, {age(until, now)} ago"
    if life.is_capped:
        return f"The set in force is older than its history can tell of: {assured} {when}, and says nothing beyond"
    return f"The set in force no longer holds by its forecast: {assured} {when}"


def _agrees_since(situation: Situation, until: datetime) -> bool:
    judged = situation.judged
    return judged is not None and judged.grade == "agrees" and judged.data_until > until


def _cure(situation: Situation) -> tuple[Action | None, str]:
    """Return the button, and what to do in words."""
    active, newest, session = situation.active, situation.newest, situation.session
    if situation.is_calibrating:
        return None, "a calibration is under way"
    if active is None:
        return None, "put a set in force"
    if newest is not None and newest.status == "candidate" and newest.data_until > active.data_until:
        if newest.grade != "refuse":
            return activate(newest.id), "activate the newer set"
        return Action("See why", "GET", f"/parameter-sets/{newest.id}"), "the newer set is refused"
    if session is not None and session.is_usable and session.data_until > active.data_until:
        return calibrate(situation, [session.id]), "calibrate the newest session"
    return Action("Send telemetry", "GET", satellite_page(situation, "#upload-telemetry")), "send a newer session"
