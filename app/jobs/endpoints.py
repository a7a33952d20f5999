"""HTTP of the queue."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Annotated, Final

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Operator, Reader, is_still_valid
from app.access.caller import Caller
from app.access.idempotency import KeyHeader, fingerprint, recall, remember
from app.http.dependencies import Blobs, Config, Db
from app.http.entity_tags import UNCHANGED, revalidated
from app.http.paging import in_short
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TABLES, table_response, wanted_format, write_table
from app.jobs.dependencies import Jobs
from app.jobs.kinds.registry import JobRequest
from app.jobs.kinds.result_series import read_series
from app.jobs.queue import Queue
from app.jobs.repository import JobRepository
from app.jobs.reprocessing import submit_reprocessing
from app.jobs.schemas import JobPage, JobQuery, JobRead, JobShort, JobShortPage, ReprocessingBody
from app.jobs.tables import Job
from app.jobs.transitions import ENDED
from app.parameter_sets.schemas import TableQuery
from app.records.arrow import from_bytes
from app.storage.database import Database

router = APIRouter(route_class=StrictJsonRoute, tags=["jobs"])

LOOK_EVERY_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Asking:
    """Who asks for a job, under which Idempotency-Key, and what it takes to answer."""

    caller: Caller
    db: Database
    queue: Queue
    response: Response
    key: str | None


def _queued_once(asked: str, submit: Callable[[Session], Job], by: Asking) -> JobRead:
    """Return the job that ``submit`` queues, or the one that it queued for the same key and ``asked`` before."""
    with by.db.write() as session:
        jobs = JobRepository(session, by.caller)
        made = recall(session, by.caller, by.key, asked)
        row = submit(session) if made is None else jobs.get(made)
        if by.key is not None and made is None:
            remember(session, by.caller, by.key, asked, row.id)
        job = jobs.read([row])[0]
    by.queue.announce()
    by.response.headers["Location"] = f"/api/v1/jobs/{job.id}"
    return job


@router.post("/jobs", status_code=202)
def create_job(
    body: JobRequest,
    caller: Operator,
    db: Db,
    config: Config,
    queue: Jobs,
    response: Response,
    key: KeyHeader = None,
) -> JobRead:
    """Queue a piece of work; with an Idempotency-Key, the same request again is the same job."""
    asked = fingerprint("POST jobs", body.model_dump_json())

    def submit(session: Session) -> Job:
        return JobRepository(session, caller).submit(body, queue, config.max_queued_jobs)

    return _queued_once(asked, submit, Asking(caller, db, queue, response, key))


@router.post("/reprocessings", status_code=202)
def create_reprocessing(
    body: ReprocessingBody,
    caller: Operator,
    db: Db,
    config: Config,
    queue: Jobs,
    response: Response,
    key: KeyHeader = None,
) -> JobRead:
    """Queue the calibration of a whole history; the answer is the job that sums it up."""
    asked = fingerprint("POST reprocessings", body.model_dump_json())

    def submit(session: Session) -> Job:
        return submit_reprocessing(session, caller, body, queue, config.max_queued_jobs)

    return _queued_once(asked, submit, Asking(caller, db, queue, response, key))


@router.get("/jobs", response_model=JobPage | JobShortPage, responses=UNCHANGED)
def list_jobs(query: Annotated[JobQuery, Query()], request: Request, caller: Reader, db: Db) -> Response:
    """List the jobs, the newest first; with `total`, counted by state."""
    return revalidated(request, jobs_now(query, caller, db))


def jobs_now(query: JobQuery, caller: Caller, db: Database) -> JobPage | JobShortPage:
    """Return a part of the jobs."""
    with db.read() as session:
        jobs = JobRepository(session, caller)
        rows, cursor, total = jobs.page(query)
        counts = jobs.counts(query) if query.total else None
        items = jobs.read(rows)
    if query.view == "full":
        return JobPage(items=items, next=cursor, total=total, counts=counts)
    short = [in_short(one, JobShort) for one in items]
    return JobShortPage(items=short, next=cursor, total=total, counts=counts)


@router.get("/jobs/{job_id}")
def get_job(job_id: str, caller: Reader, db: Db) -> JobRead:
    """Show how a job stands."""
    return _look(job_id, caller, db)


def _look(job_id: str, caller: Caller, db: Db) -> JobRead:
    with db.read() as session:
        jobs = JobRepository(session, caller)
        return jobs.read([jobs.get(job_id)])[0]


def _known_job(job_id: str, caller: Reader, db: Db) -> JobRead:
    return _look(job_id, caller, db)


@router.get("/jobs/{job_id}/events", response_class=EventSourceResponse)
async def follow_job(
    first: Annotated[JobRead, Depends(_known_job)], request: Request, caller: Reader, db: Db
) -> AsyncIterator[ServerSentEvent]:
    """Follow a job: one event a change, the last when it has ended; a revoked key sees no more."""
    job, number = first, 0
    while True:
        yield ServerSentEvent(data=job.model_dump(mode="json"), event=job.state, id=str(number))
        if job.state in ENDED:
            return
        before, number = job, number + 1
        while job == before:
            await asyncio.sleep(LOOK_EVERY_S)
            if not await run_in_threadpool(is_still_valid, request):
                return
            job = await run_in_threadpool(_look, job.id, caller, db)


@router.get("/jobs/{job_id}/series", responses=TABLES)
def get_series(
    job_id: str, query: Annotated[TableQuery, Query()], request: Request, caller: Reader, db: Db, store: Blobs
) -> Response:
    """Give the series of a simulation or an energy balance as CSV, NDJSON, JSON columns or Parquet."""
    form = wanted_format(request, query.format, "json")
    with db.read() as session:
        content = read_series(session, store, JobRepository(session, caller).get(job_id))
    return table_response(write_table(from_bytes(content), form), form, f"series-{job_id}")


@router.post("/jobs/{job_id}/retry", status_code=202)
def retry_job(
    job_id: str, caller: Operator, db: Db, config: Config, queue: Jobs, response: Response, key: KeyHeader = None
) -> JobRead:
    """Queue anew what a job that has ended was asked for; a reprocessing with all its calibrations."""
    asked = fingerprint("POST jobs retry", job_id)

    def submit(session: Session) -> Job:
        return JobRepository(session, caller).retry(job_id, queue, config.max_queued_jobs)

    return _queued_once(asked, submit, Asking(caller, db, queue, response, key))


@router.post("/jobs/{job_id}/cancel", status_code=202)
def cancel_job(job_id: str, caller: Operator, db: Db) -> JobRead:
    """Cancel a job: at once if it waits, within a second or so if it runs."""
    with db.write() as session:
        jobs = JobRepository(session, caller)
        return jobs.read([jobs.cancel(job_id)])[0]
