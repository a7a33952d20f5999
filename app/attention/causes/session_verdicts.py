"""The newest session does not agree with the set in force."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import activate, calibrate
from app.attention.situation import SessionFacts, Situation
from app.http.schemas import day_text


@dataclass(frozen=True, slots=True)
class SessionVerdict:
    """The newest session, judged against the set in force, has ``grade``; ``words`` say so."""

    grade: str
    words: str
    severity: Severity

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that the session has the grade; the button calibrates it, or activates what came of that."""
        session, active = situation.judged, situation.active
        if session is None or active is None or session.grade != self.grade:
            return None
        links = {"session_id": session.id, "parameter_set_id": active.id}
        action = _action(situation, session)
        if situation.is_calibrating and situation.job is not None:
            links["job_id"], action = situation.job.id, None
        text = f"Session of {day_text(session.data_until)} {self.words}: {_why(session)}"
        if action is None:
            text += "; a calibration is under way"
        return Finding(self.severity, text, session.created_at, f"{session.id} {active.id}", links, action)


def _why(session: SessionFacts) -> str:
    """Return the drift of the parameters, where that is a reason, and the residual with the limits that it has."""
    drifts = [reason.partition(": ")[2] for reason in session.reasons if reason.startswith("parameter_drift")]
    if session.residual_ratio is None or session.residual_rms_nt is None:
        return "; ".join(drifts)
    times = f"{_times(session.residual_ratio)} that of the set"
    residual = f"residual {session.residual_rms_nt:,.0f} nT, {times} (watched from 2 times on, disagrees from 4)"
    return "; ".join([residual, *drifts])


def _times(ratio: float) -> str:
    return f"{ratio:.0f} times" if ratio >= 10 else f"{ratio:.2g} times"


def _action(situation: Situation, session: SessionFacts) -> Action | None:
    newest = situation.newest
    if newest is not None and newest.status == "candidate" and session.id in newest.session_ids:
        if newest.grade != "refuse":
            return activate(newest.id)
        return Action("See why it is refused", "GET", f"/parameter-sets/{newest.id}")
    return calibrate(situation, [session.id])
