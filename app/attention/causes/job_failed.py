"""The newest calibration of the magnetometer has failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from typing import Final

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import satellite_page
from app.attention.situation import JobFacts, OrbitFacts, Situation, is_other_object
from app.http.schemas import day_text
from app.parameter_sets.cure_subject import scale_of_clock
from magcal_core.options import CalibrationOptions

OF_THE_ORBIT: Final = frozenset({"orbit_missing", "tle_epoch"})
"""Codes that an orbit mends, not another try."""
MOST_AGE_DAYS: Final = CalibrationOptions().max_orbit_age_days


class JobFailed:
    """The newest calibration has failed; one that is tried again, or succeeds, takes its place."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it failed and why; the button mends the cause that the diagnosis names, or tries again."""
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
        return _orbits(situation, job)
    cure = CURES.get(str(_cause(job).get("code", "")))
    found = None if cure is None else cure(situation, job)
    return found or Action("Try again", "POST", f"/api/v1/jobs/{job.id}/retry")


def _cause(job: JobFacts) -> Mapping[str, object]:
    """Return the first cause that the diagnosis of a failed job has found, empty where it has none."""
    diagnosis = (job.error or {}).get("diagnosis")
    findings = diagnosis.get("findings") if isinstance(diagnosis, Mapping) else None
    first = findings[0] if isinstance(findings, list) and findings else None
    return first if isinstance(first, Mapping) else {}


def _again(label: str, **changed: object) -> Callable[[Situation, JobFacts], Action | None]:
    """Return what offers the same calibration with ``changed``, unless it was asked for so already."""

    def offer(_situation: Situation, job: JobFacts) -> Action | None:
        if not job.session_ids or all(job.request.get(name) == value for name, value in changed.items()):
            return None
        given = {name: value for name, value in job.request.items() if value is not None}
        body = {**given, **changed, "kind": "calibration", "session_ids": list(job.session_ids)}
        return Action(label, "POST", "/api/v1/jobs", body)

    return offer


def _clock(situation: Situation, job: JobFacts) -> Action | None:
    """Return the calibration with times of the scale that the clock keeps, else with the clock as an unknown."""
    session = situation.session
    at = job.created_at if session is None or session.data_from is None else session.data_from
    scale = scale_of_clock(_cause(job), at)
    as_scale = None if scale is None else _again(f"As {scale.upper()} time", time_scale=scale)(situation, job)
    return as_scale or _again("Look for the clock", time_offset="estimate")(situation, job)


def _orbits(situation: Situation, job: JobFacts) -> Action:
    """Return the same calibration again where an orbit that serves has come since, else the way to the orbits."""
    orbit = situation.orbit
    if orbit is not None and _serves(orbit, situation, job):
        return Action(f"Use the orbit of {day_text(orbit.epoch)}", "POST", f"/api/v1/jobs/{job.id}/retry")
    return Action("Choose orbit", "GET", satellite_page(situation, "#orbits"))


def _serves(orbit: OrbitFacts, situation: Situation, job: JobFacts) -> bool:
    """Return whether ``orbit`` came after the job's end, is of the satellite, and near enough to the job's session."""
    session = situation.session
    if session is None or session.data_from is None or session.id not in job.session_ids:
        return False
    is_own = not is_other_object(situation.norad_id, orbit.norad_id)
    limit = job.request.get("max_orbit_age_days")
    most = timedelta(days=float(limit) if isinstance(limit, int | float) else MOST_AGE_DAYS)
    away = max(session.data_from - (orbit.until or orbit.epoch), orbit.epoch - session.data_until)
    return is_own and orbit.created_at > (job.finished_at or job.created_at) and away <= most


def _reading(situation: Situation, _job: JobFacts) -> Action:
    page = satellite_page(situation, f"/magnetometers/{situation.magnetometer_id}#how-its-telemetry-is-read")
    return Action("See how it is read", "GET", page)


def _readings(_situation: Situation, job: JobFacts) -> Action | None:
    return Action("See the readings", "GET", f"/sessions/{job.session_ids[0]}#readings") if job.session_ids else None


CURES: Final[Mapping[str, Callable[[Situation, JobFacts], Action | None]]] = {
    "clock": _clock,
    "bad_rows": _again("Again with tukey", robust="tukey"),
    "along_track": _orbits,
    "orbit_plane": _orbits,
    "wrong_satellite": _orbits,
    "unit": _reading,
    "axis_constant": _readings,
    "sensor_constant": _readings,
}
"""Cause that a diagnosis names -> what mends it, or shows it; without one, another try."""
