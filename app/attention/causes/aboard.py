"""The set in force is not known to fly."""

from __future__ import annotations

from datetime import datetime
from typing import Final

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.situation import Situation

STATES: Final = {
    None: "nobody has reported it aboard",
    "exported": "it was exported, not confirmed aboard",
    "uploaded": "it was uploaded, not confirmed aboard",
    "different": "what was read back differs from it",
}


class NotAboard:
    """In force on the ground, but not confirmed aboard."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return how far the set in force has come; the button goes to its export."""
        report, active = situation.aboard, situation.active
        if report is None or active is None or report.parameter_set_id != active.id:
            return None
        severity = Severity.ACT if report.state == "different" else Severity.WATCH
        text = f"The set in force may not fly: {STATES.get(report.state, 'it is not confirmed aboard')}"
        action = Action("Export", "GET", f"/parameter-sets/{active.id}#export-for-flight-software")
        since = active.begun_at or active.created_at
        about = f"{active.id} {report.state}"
        return Finding(severity, text, since, about, {"parameter_set_id": active.id}, action)
