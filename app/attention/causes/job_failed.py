"""The newest calibration of the magnetometer has failed."""

from __future__ import annotations

from datetime import datetime
from typing import Final

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import satellite_page
from app.attention.situation import JobFacts, Situation

OF_THE_ORBIT: Final = frozenset({"orbit_missing", "tle_epoch"})
"""Codes that an orbit mends, not another try."""


class JobFailed:
    """The newest calibration has failed; one that is tried again, or succeeds, takes its place."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it failed and why; the button tries again, or goes to the orbits where they are the cause."""
        job = situation.job
        if job is None or job.state != "failed":
            return None
        error = job.error or {}
        why = error.get("detail") or error.get("code") or "no reason is known"
        links = {"job_id": job.id}
        if job.session_ids:
            links["session_id"] = job.session_ids[0]
        since = job.finished_at or job.created_at
        text = f"The calibration failed: {why}"
        return Finding(Severity.ACT, text, since, job.id, links, _action(situation, job))


def _action(situation: Situation, job: JobFacts) -> Action | None:
    if (job.error or {}).get("code") in OF_THE_ORBIT:
        return Action("Choose orbit", "GET", satellite_page(situation, "#orbits"))
    return Action("Try again", "POST", f"/api/v1/jobs/{job.id}/retry")
