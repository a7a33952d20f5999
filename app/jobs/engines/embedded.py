"""The queue without a server of its own: workers of this machine claim jobs from the job table."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Sequence

import structlog
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from app.jobs.execution.attempt import Executor
from app.jobs.execution.leases import Sightings, claim_next, is_work_waiting
from app.jobs.kernels import Kernels
from app.jobs.kinds.contract import Claim
from app.jobs.tables import Job
from app.settings import Settings
from app.storage.database import Database
from app.storage.store import Store

log = structlog.get_logger()


class EmbeddedQueue:
    """Wakes the workers of this process; those of other processes poll the table."""

    def __init__(self) -> None:
        self.news = threading.Condition()
        self.announced = 0

    def enqueue(self, session: Session, jobs: Sequence[Job]) -> None:
        """Add ``jobs`` to the table: that is all it takes."""
        session.add_all(jobs)

    def announce(self) -> None:
        """Wake the workers of this process."""
        with self.news:
            self.announced += 1
            self.news.notify_all()

    def check(self) -> None:
        """Nothing of its own can be out of reach: the database is checked by itself."""


class EmbeddedWorkers:
    """Threads that each claim a job, supervise its calculation, and claim the next."""

    def __init__(self, database: Database, store: Store, settings: Settings, queue: EmbeddedQueue, count: int) -> None:
        self._database = database
        self._settings = settings
        self._queue = queue
        self._sightings = Sightings(settings.job_lease_s, settings.job_heartbeat_s)
        self._stopping = threading.Event()
        self.kernels = Kernels()
        self._executors = [Executor(database, store, settings, queue) for _ in range(count)]
        self._threads = [
            threading.Thread(target=self._work, args=(executor, f"{socket.gethostname()}:{os.getpid()}:{number}"))
            for number, executor in enumerate(self._executors)
        ]

    def start(self) -> None:
        """Start the threads; each starts its child once the kernels are ready, then gives it work."""
        self.kernels.prepare()
        for thread in self._threads:
            thread.start()

    def stop(self, grace_s: float) -> None:
        """Take no more jobs; give those that run ``grace_s`` seconds, then hand them back."""
        self._stopping.set()
        self._queue.announce()
        for thread in self._threads:
            thread.join(grace_s / max(1, len(self._threads)))
        for executor in self._executors:
            executor.close()
        for thread in self._threads:
            thread.join()
        for executor in self._executors:
            executor.calculator.kill()
        self.kernels.stop()

    def _work(self, executor: Executor, name: str) -> None:
        if not self.kernels.wait(self._stopping):
            return
        executor.calculator.prepare()
        is_busy = False
        while not self._stopping.is_set():
            seen = self._queue.announced
            claim = self._claim(name, is_busy)
            is_busy = claim is not None
            if claim is not None:
                executor.execute(claim)
                continue
            with self._queue.news:
                if self._queue.announced == seen and not self._stopping.is_set():
                    self._queue.news.wait(self._settings.job_poll_s)

    def _claim(self, name: str, is_busy: bool) -> Claim | None:
        """Return the next claim; one who is not busy looks first whether there is work, which takes no lock."""
        try:
            with self._database.read() as session:
                if not (is_busy or is_work_waiting(session, self._sightings.lapsed(session))):
                    return None
            with self._database.write() as session:
                lapsed = self._sightings.lapsed(session)
                return claim_next(session, name, self._settings.job_lease_s, self._settings.job_attempts, lapsed)
        except OperationalError as error:
            log.warning("claim_failed", error=str(error.orig))
            self._stopping.wait(1.0)
            return None
