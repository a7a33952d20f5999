"""One attempt at one job, the same under every queue: load, calculate in the child, keep the result if still ours."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final, TypeVar

import structlog
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.jobs.execution.child import Failure, Task
from app.jobs.execution.child_supervisor import AbandonedError, Calculator, ChildDiedError, TimedOutError
from app.jobs.execution.leases import LostClaimError, finish, hand_back, is_cancelled, renew
from app.jobs.kinds.contract import Claim, JobKind, Outcome
from app.jobs.kinds.registry import JOB_KINDS
from app.jobs.queue import Queue
from app.jobs.tables import Job
from app.metrics import JOB_SECONDS
from app.problems import Problem, problem, problem_of
from app.settings import Settings
from app.storage.database import Database
from app.storage.retry import AWAY, outlasting
from app.storage.store import Store
from magcal_core.errors import MagcalError

log = structlog.get_logger()

Result = TypeVar("Result")
CANCEL_CHECK_S: Final = 0.5
PATIENCE_S: Final = 60.0
"""A result waits so long for a database that is away; then the job is another attempt's."""
INTERNAL: Final = problem(500, "internal", "the job failed unexpectedly; the log has it under the job's id")


class Executor:
    """Executes jobs one after the other, with one child process for the calculations."""

    def __init__(self, database: Database, store: Store, settings: Settings, queue: Queue) -> None:
        self._database = database
        self._store = store
        self._settings = settings
        self._queue = queue
        self._closing = threading.Event()
        warm = tuple(kind.warm for kind in JOB_KINDS.values() if kind.warm)
        self.calculator = Calculator(settings.job_memory_mb, warm)

    def close(self) -> None:
        """Let a running job be handed back at its next sign of life."""
        self._closing.set()

    def execute(self, claim: Claim) -> None:
        """Bring the claimed job to its end, or hand it back where only its worker failed."""
        with structlog.contextvars.bound_contextvars(job_id=claim.job_id, attempt=claim.attempt):
            begun = time.monotonic()
            try:
                state = self._attempt(claim)
            except LostClaimError:
                state = "lost"
            except AWAY as error:
                log.warning("database_lost", error=str(error))
                state = "lost"  # the lease runs out and another attempt takes the job over
            except Exception:  # the worker's loop: an unforeseen error ends the job, not the worker
                log.exception("job_error")
                state = self._fail_if_possible(claim)
            elapsed = time.monotonic() - begun
            JOB_SECONDS.labels(claim.kind, state).observe(elapsed)
            log.info("job_ended", kind=claim.kind, state=state, duration_s=round(elapsed, 4))

    def _fail_if_possible(self, claim: Claim) -> str:
        try:
            return self._fail(claim, INTERNAL)
        except (LostClaimError, SQLAlchemyError):
            return "lost"  # the lease runs out and another attempt takes the job over

    def _attempt(self, claim: Claim) -> str:
        kind = JOB_KINDS[claim.kind]
        watch = _Watch(self._database, claim, self._settings, self._closing)
        try:
            work = self._outlasting(lambda: self._load(claim, kind))
            found = self.calculator.run(Task(kind.function, work), self._settings.job_timeout_s, watch)
        except AbandonedError:
            return self._abandon(claim, watch)
        except ChildDiedError as error:
            return self._lose(claim, error)
        except TimedOutError as error:
            return self._fail(claim, problem(500, error.code, error.message))
        except MagcalError as error:
            return self._fail(claim, problem_of(error))
        if isinstance(found, Failure):
            if found.trace is not None:
                log.error("calculation_error", trace=found.trace)
            return self._fail(claim, found.problem)
        return self._outlasting(lambda: self._keep(claim, found))

    def _outlasting(self, work: Callable[[], Result]) -> Result:
        """Return what ``work`` returns, however often the database loses it or goes away meanwhile."""
        return outlasting(work, PATIENCE_S, self._closing.wait)

    def _load(self, claim: Claim, kind: JobKind) -> object:
        with self._database.read() as session:
            return kind.load(session, self._store, claim)

    def _keep(self, claim: Claim, found: Outcome) -> str:
        with self._database.write() as session:
            result = JOB_KINDS[claim.kind].keep(session, self._store, claim, found)
            finish(session, claim, "succeeded", result=result)
        return "succeeded"

    def _fail(self, claim: Claim, why: Problem) -> str:
        def end() -> str:
            with self._database.write() as session:
                finish(session, claim, "failed", error=why)
            return "failed"

        return self._outlasting(end)

    def _abandon(self, claim: Claim, watch: _Watch) -> str:
        if not watch.is_held:
            raise LostClaimError(f"attempt {claim.attempt} no longer holds job {claim.job_id}")
        with self._database.write() as session:
            if watch.is_cancelled:
                finish(session, claim, "cancelled")
                return "cancelled"
            self._hand_back(session, claim, is_lost=False)
        return "handed back"

    def _hand_back(self, session: Session, claim: Claim, *, is_lost: bool) -> None:
        hand_back(session, claim, is_lost=is_lost)
        self._queue.enqueue(session, [session.get_one(Job, claim.job_id)])

    def _lose(self, claim: Claim, error: ChildDiedError) -> str:
        with self._database.write() as session:
            if claim.lost_attempts + 1 >= self._settings.job_attempts:
                detail = f"{error.message}; {claim.lost_attempts + 1} attempts ended like this"
                finish(session, claim, "failed", error=problem(500, "dead", detail))
                return "dead"
            self._hand_back(session, claim, is_lost=True)
        self._queue.announce()
        log.warning("calculation_lost", why=error.message)
        return "lost"


class _Watch:
    """Called while a calculation runs: renews the lease, notes the progress, learns of cancellation."""

    def __init__(self, database: Database, claim: Claim, settings: Settings, closing: threading.Event) -> None:
        self._database = database
        self._claim = claim
        self._settings = settings
        self._closing = closing
        self._renewed_at = self._checked_at = time.monotonic()
        self.is_held = True
        self.is_cancelled = False

    def __call__(self, progress: float) -> bool:
        try:
            self._look(progress)
        except AWAY as error:
            # Nobody else can take the job over meanwhile; whether they did is told when the database is back.
            log.warning("database_away", error=str(error))
            self._checked_at = time.monotonic()
        return self.is_held and not self.is_cancelled and not self._closing.is_set()

    def _look(self, progress: float) -> None:
        now = time.monotonic()
        if now - self._checked_at < min(CANCEL_CHECK_S, self._settings.job_heartbeat_s):
            return
        if now - self._renewed_at >= self._settings.job_heartbeat_s:
            with self._database.write() as session:
                renewal = renew(session, self._claim, self._settings.job_lease_s, progress)
            self.is_held, self.is_cancelled = renewal.is_held, renewal.is_cancelled
            self._renewed_at = now
        else:
            with self._database.read() as session:
                self.is_cancelled = is_cancelled(session, self._claim)
        self._checked_at = now
