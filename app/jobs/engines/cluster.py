"""The queue on PostgreSQL: procrastinate hands jobs out to workers on many machines.

A job stays a row of magcal's own table; procrastinate's row only says that somebody is to look at it. So what
procrastinate does not fence (a paused worker may end a job that another has taken over) cannot end a job of ours, and
a sweep hands out again what procrastinate has lost sight of.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import procrastinate
import structlog
from procrastinate.exceptions import ConnectorException
from sqlalchemy import TextClause, and_, column, literal_column, make_url, or_, select, table, text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.errors import UnavailableError
from app.jobs.execution.attempt import PATIENCE_S, Executor
from app.jobs.execution.leases import bury_lost, claim_one, lapsed_by_clock
from app.jobs.kernels import Kernels
from app.jobs.kinds.contract import Claim
from app.jobs.request_version import QUEUES, queue_of
from app.jobs.tables import Job
from app.settings import Settings
from app.storage.database import Database, DatabaseNow
from app.storage.retry import outlasting
from app.storage.store import Store

TASK: Final = "magcal.job"
SWEEP_EVERY_S: Final = 2.0
LOST_SIGHT_S: Final = 1.0
"""A job whose lease ran out so long ago, and that procrastinate does not hand out, is handed out again."""
MOST_AT_ONCE: Final = 100
RESTART_S: Final = 1.0
LOOP_GRACE_S: Final = 10.0
"""So long procrastinate's loop has to close its connections once no job is left in hand."""
ROUND_S: Final = 2.0
"""So long a worker goes on to take jobs before procrastinate's own loop has its turn."""

log = structlog.get_logger()
handed_out = table("procrastinate_jobs", column("id"), column("status"))
FETCH: Final = text(
    "SELECT id, args ->> 'job_id' AS job_id FROM procrastinate_fetch_job_v2(CAST(:queues AS varchar[]), :worker_id)"
).bindparams(queues=list(QUEUES))
END: Final = text(
    "SELECT procrastinate_finish_job_v1(id, 'succeeded', true) FROM procrastinate_jobs "
    "WHERE id = :queue_id AND status IN ('todo', 'doing')"
)
UNLOCK: Final = text("UPDATE procrastinate_jobs SET lock = NULL WHERE id = :queue_id")


@dataclass(frozen=True, slots=True)
class Handed:
    """A row of procrastinate's that this worker has in hand, and the claim on its job where that can be had."""

    queue_id: int
    claim: Claim | None


class ClusterQueue:
    """Enqueues through the connection of the transaction that makes the job."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._app = procrastinate.App(connector=procrastinate.SyncPsycopgConnector())

    def enqueue(self, session: Session, jobs: Sequence[Job]) -> None:
        """Hand ``jobs`` out with the session's transaction."""
        session.add_all(jobs)
        session.flush()
        connection = session.connection().connection.driver_connection
        for job in jobs:
            deferrer = self._app.configure_task(
                TASK, queue=queue_of(job.request_version), lock=job.lock, priority=-job.rank, connection=connection
            )
            try:
                job.queue_id = deferrer.defer(job_id=job.id)
            except ConnectorException as error:
                raise UnavailableError("the queue does not take the job; try again") from error
        session.flush()

    def announce(self) -> None:
        """Nothing to tell: PostgreSQL notifies the workers when the transaction is committed."""

    def check(self) -> None:
        """Raise UnavailableError where procrastinate's tables are not there."""
        try:
            with self._database.read() as session:
                session.execute(select(handed_out.c.id).limit(1))
        except SQLAlchemyError as error:
            raise UnavailableError("the queue's tables cannot be read") from error


class ClusterWorkers:
    """A procrastinate worker in a thread with an event loop, over executors that each have a child process."""

    def __init__(self, database: Database, store: Store, settings: Settings, cluster: ClusterQueue, count: int) -> None:
        self._database = database
        self._settings = settings
        self._queue = cluster
        self._count = count
        self._name = f"{socket.gethostname()}:{os.getpid()}"
        self._executors = [Executor(database, store, settings, cluster) for _ in range(count)]
        self._free: queue.SimpleQueue[Executor] = queue.SimpleQueue()
        self.kernels = Kernels()
        self._thread = threading.Thread(target=self._work_when_ready, daemon=True)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._running: asyncio.Task[None] | None = None
        self._stopping = threading.Event()

    def start(self) -> None:
        """Start the thread, which starts the children once the kernels are ready, then gives them work."""
        self.kernels.prepare()
        self._thread.start()

    def stop(self, grace_s: float) -> None:
        """Take no more jobs; give those that run ``grace_s`` seconds, then hand them back."""
        self._stopping.set()
        self._interrupt()
        self._thread.join(grace_s)
        for executor in self._executors:
            executor.close()
        self._thread.join(LOOP_GRACE_S)
        if self._thread.is_alive():
            # The jobs are handed back: what is left is the library's own, and must not keep the process from its end.
            log.warning("queue_loop_left", waited_s=LOOP_GRACE_S)
        for executor in self._executors:
            executor.calculator.kill()
        self.kernels.stop()

    def _work_when_ready(self) -> None:
        if not self.kernels.wait(self._stopping):
            return
        for executor in self._executors:
            executor.calculator.prepare()
            self._free.put(executor)
        asyncio.run(self._run())

    def _interrupt(self) -> None:
        """End procrastinate's worker; unless the workers are stopping, another begins in its place."""
        if self._loop is not None and self._running is not None:
            self._loop.call_soon_threadsafe(self._running.cancel)

    async def _run(self) -> None:
        self._loop = asyncio.get_running_loop()
        while not self._stopping.is_set():
            self._running = asyncio.create_task(self._work())
            try:
                await self._running
            except asyncio.CancelledError:
                log.info("worker_ended", is_stopping=self._stopping.is_set())
            except Exception:  # the worker's loop: it starts anew when the database is back
                log.exception("worker_interrupted")
                await asyncio.sleep(RESTART_S)

    async def _work(self) -> None:
        settings = self._settings
        conninfo = make_url(settings.url).set(drivername="postgresql").render_as_string(hide_password=False)
        app = procrastinate.App(connector=procrastinate.PsycopgConnector(conninfo=conninfo, max_size=self._count + 4))
        app.task(name=TASK, pass_context=True)(self._job)
        async with app.open_async():
            sweeping = asyncio.create_task(self._sweep(app))
            try:
                await app.run_worker_async(
                    queues=list(QUEUES),
                    name=self._name,
                    concurrency=self._count,
                    install_signal_handlers=False,
                    fetch_job_polling_interval=SWEEP_EVERY_S,
                    update_heartbeat_interval=settings.job_heartbeat_s,
                    stalled_worker_timeout=settings.job_lease_s,
                    delete_jobs="always",
                )
            finally:
                sweeping.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await sweeping

    async def _job(self, context: procrastinate.JobContext, job_id: str) -> None:
        """Work on a job, unless it has ended or another attempt holds it, and on those that come next."""
        await asyncio.to_thread(self._take, job_id, context.job)

    def _take(self, job_id: str, handed: procrastinate.jobs.Job) -> None:
        claim = outlasting(lambda: self._claim(job_id), PATIENCE_S, self._stopping.wait)
        executor = self._free.get()
        try:
            if claim is not None:
                executor.execute(claim)
            if handed.worker_id is not None and handed.id is not None:
                self._go_on(executor, handed.worker_id, handed.id)
        except SQLAlchemyError as error:
            # Which rows are in hand is no longer sure: those of a worker that has ended are handed out again.
            log.warning("round_ended", error=str(error))
            self._interrupt()
        finally:
            self._free.put(executor)

    def _claim(self, job_id: str) -> Claim | None:
        with self._database.write() as session:
            return self._claim_in(session, job_id)

    def _claim_in(self, session: Session, job_id: str) -> Claim | None:
        return claim_one(session, job_id, self._name, self._settings.job_lease_s, self._settings.job_attempts)

    def _go_on(self, executor: Executor, worker_id: int, first_id: int) -> None:
        """Take what procrastinate hands out next with two transactions a job, where its own loop needs several more.

        The first row stays procrastinate's to end, so only its lock is let go; the others are ended here.
        """
        until = time.monotonic() + ROUND_S
        leave: TextClause | None = UNLOCK
        before = first_id
        try:
            while leave is not None and time.monotonic() < until and not self._stopping.is_set():
                handed = self._next(worker_id, leave, before)
                leave = None if handed is None else END
                if handed is not None:
                    before = handed.queue_id
                    if handed.claim is not None:
                        executor.execute(handed.claim)
        finally:
            if leave is END:
                self._leave(before)

    def _next(self, worker_id: int, leave: TextClause, before: int) -> Handed | None:
        """Return what procrastinate hands out next; the row ``before`` is left in the same transaction."""

        def fetch() -> Handed | None:
            with self._database.write() as session:
                session.execute(leave, {"queue_id": before})
                row = session.execute(FETCH, {"worker_id": worker_id}).one()
                return None if row.id is None else Handed(row.id, self._claim_in(session, row.job_id))

        return outlasting(fetch, PATIENCE_S, self._stopping.wait)

    def _leave(self, queue_id: int) -> None:
        def end() -> None:
            with self._database.write() as session:
                session.execute(END, {"queue_id": queue_id})

        outlasting(end, PATIENCE_S, self._stopping.wait)

    async def _sweep(self, app: procrastinate.App) -> None:
        """Hand out again, every few seconds, what a lost worker held."""
        while True:
            await asyncio.sleep(SWEEP_EVERY_S)
            try:
                stalled = await app.job_manager.get_stalled_jobs(
                    seconds_since_heartbeat=self._settings.job_lease_s + LOST_SIGHT_S
                )
                for job in stalled:
                    if job.id is not None:
                        await self._retry(app, job.id)
                await asyncio.to_thread(self._hand_out_again)
            except (ConnectorException, SQLAlchemyError) as error:
                log.warning("sweep_failed", error=str(error))

    async def _retry(self, app: procrastinate.App, queue_id: int) -> None:
        now = procrastinate.utils.utcnow()
        with contextlib.suppress(ConnectorException):  # another worker's sweep was first
            await app.job_manager.retry_job_by_id_async(queue_id, retry_at=now)
            log.info("stalled_job_handed_out", queue_id=queue_id)

    def _hand_out_again(self) -> None:
        """Enqueue anew the jobs that wait or lost their worker, and that procrastinate does not know any more."""
        is_known = select(handed_out.c.id).where(
            handed_out.c.id == Job.queue_id,
            handed_out.c.status.in_([literal_column("'todo'"), literal_column("'doing'")]),
        )
        is_lost = and_(Job.state == "running", Job.lease_until < DatabaseNow(-LOST_SIGHT_S))
        waits = and_(Job.state == "queued", Job.created_at < DatabaseNow(-60.0))
        with self._database.write() as session:
            bury_lost(session, self._settings.job_attempts, lapsed_by_clock())
            lost = (
                select(Job)
                .where(or_(is_lost, waits), ~is_known.exists())
                .with_for_update(skip_locked=True)
                .limit(MOST_AT_ONCE)
            )
            jobs = session.scalars(lost).all()
            if jobs:
                self._queue.enqueue(session, jobs)
                log.info("lost_jobs_handed_out", jobs=len(jobs))
