"""Jobs, as far as the caller's key reaches: queue, look at, cancel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from sqlalchemy import ColumnElement, Select, func, or_, select, true
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import ConflictError, NotFoundError
from app.http.paging import Part, Ways, fetch_page
from app.jobs.fair_order import take_turns
from app.jobs.kinds.contract import Admission
from app.jobs.kinds.registry import JOB_KINDS
from app.jobs.queue import Queue
from app.jobs.quota import check_quota
from app.jobs.reprocessing import KIND, progress_of, retry_reprocessing
from app.jobs.schemas import JobBody, JobQuery, JobRead
from app.jobs.tables import Job, JobSession
from app.jobs.transitions import ENDED, cancel, cancel_sum, new_job
from app.parameter_sets.tables import ParameterSet

JOBS: Final = Ways({"created": (Job.id,)}, searched=(Job.id, Job.satellite_id, Job.magnetometer_id, Job.kind))


class JobRepository:
    """The jobs that a caller reaches: those of its satellites, and its own where they have none."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller

    def submit(self, body: JobBody, queue: Queue, most_queued: int | None = None) -> Job:
        """Return the new job that ``body`` asks for, handed to ``queue`` in the session's transaction.

        ``most_queued`` is the quota of a person's request; a policy's has none, and what would make its job fail is
        left to show in the job.
        """
        kind = JOB_KINDS[body.kind]
        admission = kind.admit(self.session, self.caller, body)
        if most_queued is not None:
            check_quota(self.session, self.caller, most_queued, 1)
            kind.check(self.session, admission)
        job = self._queued(body.kind, body.priority, admission, queue)
        record_event(self.session, self.caller, f"job.{body.kind}", job.id, job.satellite_id)
        return job

    def retry(self, job_id: str, queue: Queue, most_queued: int) -> Job:
        """Return a new job of what the job ``job_id``, which has ended, was asked for.

        Raises
        ------
        ConflictError
            The job has not ended.
        QuotaError
            More than ``most_queued`` jobs of the caller's key would wait.
        """
        job = self.get(job_id)
        if job.state not in ENDED:
            raise ConflictError(f"the job is {job.state}: cancel it, or wait until it has ended")
        if job.kind == KIND:
            return retry_reprocessing(self.session, self.caller, job, queue, most_queued)
        links = select(JobSession.session_id).where(JobSession.job_id == job_id).order_by(JobSession.session_id)
        session_ids = self.session.scalars(links).all()
        admission = Admission(job.request, job.satellite_id, job.magnetometer_id, session_ids, job.lock)
        check_quota(self.session, self.caller, most_queued, 1)
        JOB_KINDS[job.kind].check(self.session, admission)
        made = self._queued(job.kind, job.priority, admission, queue)
        record_event(self.session, self.caller, "job.retry", made.id, made.satellite_id, reason=f"job {job.id}")
        return made

    def _queued(self, kind: str, priority: int, admission: Admission, queue: Queue) -> Job:
        job = new_job(
            kind,
            priority,
            admission.request,
            self.caller.key_id,
            satellite_id=admission.satellite_id,
            magnetometer_id=admission.magnetometer_id,
            lock=admission.lock,
        )
        take_turns(self.session, [job])
        queue.enqueue(self.session, [job])
        self.session.flush()
        self.session.add_all(JobSession(job_id=job.id, session_id=one) for one in admission.session_ids)
        return job

    def get(self, job_id: str) -> Job:
        """Return the job ``job_id``."""
        row = self.session.scalar(select(Job).where(Job.id == job_id, self._within_reach()))
        if row is None:
            raise NotFoundError("no such job")
        return row

    def page(self, query: JobQuery) -> Part[Job]:
        """Return a part of the jobs."""
        statement = self._wanted(query)
        if query.state is not None:
            statement = statement.where(Job.state == query.state)
        return fetch_page(self.session, statement, JOBS, query)

    def counts(self, query: JobQuery) -> dict[str, int]:
        """Return how many of the jobs that ``query`` asks for there are of each state, whichever it asks for."""
        wanted = self._wanted(query).where(JOBS.holding(query))
        by_state = wanted.with_only_columns(Job.state, func.count()).group_by(Job.state)
        return {str(state): int(count) for state, count in self.session.execute(by_state)}

    def _wanted(self, query: JobQuery) -> Select[Job]:
        """Return the statement of what ``query`` asks for, in every state."""
        statement = select(Job).where(self._within_reach())
        equal = {
            Job.kind: query.kind,
            Job.satellite_id: query.satellite,
            Job.magnetometer_id: query.magnetometer,
            Job.parent_id: query.parent,
        }
        for column, wanted in equal.items():
            if wanted is not None:
                statement = statement.where(column == wanted)
        if query.session is not None:
            of_session = select(JobSession.job_id).where(JobSession.session_id == query.session)
            statement = statement.where(Job.id.in_(of_session))
        return statement

    def cancel(self, job_id: str) -> Job:
        """Return the job ``job_id``, cancelled if it waited, about to be if it runs."""
        job = self.get(job_id)
        if job.kind != KIND:  # a reprocessing's children are locked before it
            self.session.refresh(job, with_for_update={"key_share": True})
        if job.state in ENDED:
            raise ConflictError(f"the job has {job.state} already")
        if job.kind == KIND:
            cancel_sum(self.session, job_id)
        else:
            cancel(self.session, job_id)
        record_event(self.session, self.caller, "job.cancel", job_id, job.satellite_id)
        self.session.flush()
        self.session.refresh(job)
        return job

    def read(self, jobs: Sequence[Job]) -> list[JobRead]:
        """Return ``jobs`` as the service tells of them."""
        sessions: dict[str, list[str]] = {job.id: [] for job in jobs}
        links = select(JobSession).where(JobSession.job_id.in_(sessions)).order_by(JobSession.session_id)
        for link in self.session.scalars(links):
            sessions[link.job_id].append(link.session_id)
        verdicts = self._verdicts(jobs)
        return [_read(job, sessions[job.id], self._progress(job), verdicts.get(job.id)) for job in jobs]

    def _verdicts(self, jobs: Sequence[Job]) -> dict[str, str]:
        """Return the verdict of each job's parameter set, where it made one."""
        made = [job.id for job in jobs if job.kind == "calibration" and job.state == "succeeded"]
        if not made:
            return {}
        found = select(ParameterSet.job_id, ParameterSet.grade).where(ParameterSet.job_id.in_(made))
        return dict(self.session.execute(found).all())

    def _progress(self, job: Job) -> float:
        is_sum = job.kind == KIND and job.state == "running"
        return progress_of(self.session, job.id) if is_sum else job.progress

    def _within_reach(self) -> ColumnElement[bool]:
        if self.caller.satellites is None:
            return true()
        own = (Job.satellite_id.is_(None)) & (Job.created_by == self.caller.key_id)
        return or_(Job.satellite_id.in_(sorted(self.caller.satellites)), own)


def _read(job: Job, session_ids: list[str], progress: float, verdict: str | None) -> JobRead:
    return JobRead.model_validate(
        {
            "id": job.id,
            "kind": job.kind,
            "state": job.state,
            "progress": progress,
            "attempts": job.attempts,
            "worker": job.worker,
            "priority": job.priority,
            "satellite": job.satellite_id,
            "magnetometer": job.magnetometer_id,
            "session_ids": session_ids,
            "parent_id": job.parent_id,
            "options": job.request,
            "error": job.error,
            "result": job.result,
            "verdict": verdict,
            "cancel_requested": job.cancel_requested,
            "created_at": job.created_at,
            "created_by": job.created_by,
            "started_at": job.started_at,
            "finished_at": job.finished_at,
        }
    )
