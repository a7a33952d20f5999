"""The newest set is refused; the set in force is weak, or there is none."""

from __future__ import annotations

from datetime import datetime

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import activate, calibrate
from app.attention.situation import Situation
from app.http.schemas import day_text


class SetRefused:
    """The newest calibration found no set that holds."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that the newest set, newer than the one in force, is refused; the button shows why."""
        newest, active = situation.newest, situation.active
        if newest is None or newest.grade != "refuse" or newest.status != "candidate":
            return None
        if active is not None and active.id > newest.id:
            return None
        text = f"The newest calibration, of data until {day_text(newest.data_until)}, is refused"
        action = Action("See why", "GET", f"/parameter-sets/{newest.id}")
        links = {"parameter_set_id": newest.id, "job_id": newest.job_id}
        return Finding(Severity.ACT, text, newest.created_at, newest.id, links, action)


class ActiveWeak:
    """The set in force is weak, or was refused and put in force all the same."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it is weak; the button activates a newer one that is accepted, or shows why."""
        active, newest = situation.active, situation.newest
        if active is None or active.grade == "accept":
            return None
        severity = Severity.ACT if active.grade == "refuse" else Severity.WATCH
        word = "refused and in force all the same" if active.grade == "refuse" else "weak"
        text = f"The set in force, of data until {day_text(active.data_until)}, is {word}"
        action = Action("See why", "GET", f"/parameter-sets/{active.id}")
        if newest is not None and newest.id > active.id and newest.grade == "accept" and newest.status == "candidate":
            action = activate(newest.id)
        since = active.begun_at or active.created_at
        return Finding(severity, text, since, active.id, {"parameter_set_id": active.id}, action)


class NoActiveSet:
    """No set is in force."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that nothing is in force; the button activates what was found, or calibrates what has arrived."""
        if situation.active is not None:
            return None
        newest, session = situation.newest, situation.session
        if newest is not None and newest.grade != "refuse":
            found = (
                f"No set is in force; the newest, of data until {day_text(newest.data_until)}, is {_word(newest.grade)}"
            )
            links = {"parameter_set_id": newest.id}
            return Finding(Severity.ACT, found, newest.created_at, newest.id, links, activate(newest.id))
        if session is None:
            return Finding(Severity.WATCH, "No telemetry yet, and no set is in force", situation.created_at, "")
        links = {"session_id": session.id}
        if situation.is_calibrating and situation.job is not None:
            links["job_id"] = situation.job.id
            text = "No set is in force; a calibration is under way"
            return Finding(Severity.WATCH, text, session.created_at, session.id, links)
        action = calibrate(situation, [session.id]) if session.is_usable and newest is None else None
        return Finding(Severity.ACT, "No set is in force", session.created_at, session.id, links, action)


def _word(grade: str) -> str:
    return "accepted" if grade == "accept" else grade
