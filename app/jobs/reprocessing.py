"""Bulk reprocessing: one request for the calibrations of a whole history, with a progress of its own.

The request is a job that no worker takes: it runs as long as one of its calibrations does, and ends with the last.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import ConflictError
from app.indices.repository import FIELD_FILE, check_field
from app.jobs.fair_order import take_turns
from app.jobs.queue import Queue
from app.jobs.quota import check_quota
from app.jobs.schemas import ReprocessingBody
from app.jobs.tables import Job, JobSession
from app.jobs.transitions import UNENDED, counts_of, new_job
from app.records.calibration_options import as_asked
from app.satellites.reading import options_of
from app.satellites.repository import SatelliteRepository, within_reach
from app.satellites.tables import Magnetometer
from app.sessions.tables import TelemetrySession
from magcal_core.options import CalibrationOptions

KIND: Final = "reprocessing"


def submit_reprocessing(
    session: Session, caller: Caller, body: ReprocessingBody, queue: Queue, most_queued: int
) -> Job:
    """Return the job that sums up a calibration of each session that ``body`` names, all of them enqueued.

    Raises
    ------
    QuotaError
        With these, more than ``most_queued`` jobs of the caller's key would wait.
    """
    options = as_asked(CalibrationOptions.from_dict(body.options))
    file = {} if body.field_file is None else {FIELD_FILE: body.field_file}
    check_field(session, options | file)
    chosen = _sessions(session, caller, body)
    if not chosen:
        raise ConflictError("there is no closed session to reprocess")
    check_quota(session, caller, most_queued, len(chosen))
    satellites = {row.satellite_id for row in chosen}
    satellite_id = satellites.pop() if len(satellites) == 1 else None
    parent = new_job(KIND, body.priority, options | file, caller.key_id, is_sum=True, satellite_id=satellite_id)
    said = _said(session)
    jobs = [
        new_job(
            "calibration",
            body.priority,
            as_asked(CalibrationOptions.from_dict(said[_place(row)] | body.options)) | file,
            caller.key_id,
            satellite_id=row.satellite_id,
            magnetometer_id=row.magnetometer_id,
            parent_id=parent.id,
        )
        for row in chosen
    ]
    _enqueue(session, queue, parent, jobs, [[row.id] for row in chosen])
    record_event(session, caller, "job.reprocessing", parent.id, parent.satellite_id)
    return parent


def retry_reprocessing(session: Session, caller: Caller, ended: Job, queue: Queue, most_queued: int) -> Job:
    """Return a new job that sums up each calibration of a reprocessing that has ended, all of them enqueued again.

    One whose session has lost its telemetry since fails, and says so.

    Raises
    ------
    QuotaError
        With these, more than ``most_queued`` jobs of the caller's key would wait.
    """
    before = session.scalars(select(Job).where(Job.parent_id == ended.id).order_by(Job.id)).all()
    if not before:
        raise ConflictError("the calibrations of this reprocessing are no longer there")
    check_quota(session, caller, most_queued, len(before))
    check_field(session, ended.request)
    links = select(JobSession.job_id, JobSession.session_id).join(Job, Job.id == JobSession.job_id)
    sessions: dict[str, list[str]] = {one.id: [] for one in before}
    for job_id, session_id in session.execute(links.where(Job.parent_id == ended.id)):
        sessions[job_id].append(session_id)
    parent = new_job(KIND, ended.priority, ended.request, caller.key_id, is_sum=True, satellite_id=ended.satellite_id)
    jobs = [
        new_job(
            one.kind,
            one.priority,
            one.request,
            caller.key_id,
            satellite_id=one.satellite_id,
            magnetometer_id=one.magnetometer_id,
            parent_id=parent.id,
        )
        for one in before
    ]
    _enqueue(session, queue, parent, jobs, [sessions[one.id] for one in before])
    record_event(session, caller, "job.retry", parent.id, parent.satellite_id, reason=f"job {ended.id}")
    return parent


def _enqueue(
    session: Session, queue: Queue, parent: Job, jobs: Sequence[Job], session_ids: Sequence[Sequence[str]]
) -> None:
    """Keep ``parent`` and hand out its ``jobs``, each with its sessions."""
    session.add(parent)
    session.flush()
    take_turns(session, jobs)
    queue.enqueue(session, jobs)
    session.flush()
    pairs = zip(jobs, session_ids, strict=True)
    session.add_all(JobSession(job_id=job.id, session_id=one) for job, own in pairs for one in own)


def _sessions(session: Session, caller: Caller, body: ReprocessingBody) -> Sequence[TelemetrySession]:
    wanted = select(TelemetrySession).where(
        within_reach(TelemetrySession.satellite_id, caller),
        TelemetrySession.state == "closed",
        TelemetrySession.raw_removed_at.is_(None),
    )
    if body.satellites is not None:
        named = [SatelliteRepository(session, caller).get(one).id for one in body.satellites]
        wanted = wanted.where(TelemetrySession.satellite_id.in_(named))
    if body.magnetometer is not None:
        wanted = wanted.where(TelemetrySession.magnetometer_id == body.magnetometer)
    if body.since is not None:
        wanted = wanted.where(TelemetrySession.data_until >= body.since)
    if body.until is not None:
        wanted = wanted.where(TelemetrySession.data_from <= body.until)
    return session.scalars(wanted.order_by(TelemetrySession.id)).all()


def _place(row: TelemetrySession) -> tuple[str, str]:
    return row.satellite_id, row.magnetometer_id


def _said(session: Session) -> dict[tuple[str, str], dict[str, object]]:
    """Return what each magnetometer says of its calibrations' options."""
    return {(row.satellite_id, row.id): options_of(row) for row in session.scalars(select(Magnetometer))}


def progress_of(session: Session, parent_id: str) -> float:
    """Return the share of a reprocessing's calibrations that have ended."""
    counts = counts_of(session, parent_id)
    total = sum(counts.values())
    return 1.0 if not total else 1.0 - sum(counts.get(state, 0) for state in UNENDED) / total
