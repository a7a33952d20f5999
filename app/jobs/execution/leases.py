"""How an attempt takes, holds and ends a job: every statement is fenced by the attempt's number.

Times are the database's own; on SQLite, whose clock is the machine's, `Sightings` guards against its steps. A lease
that ran out means that its worker is lost; the next claim takes the job over and counts the loss, and a job that lost
too many workers is dead.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Final

from sqlalchemy import ColumnElement, Select, Update, and_, bindparam, case, or_, select, update
from sqlalchemy.orm import Session

from app.errors import ServiceError
from app.jobs.kinds.contract import Claim
from app.jobs.reprocessing import settle
from app.jobs.tables import Job
from app.problems import Problem, problem
from app.storage.database import DatabaseNow, JsonColumn

DEAD: Final = "dead"
JOBS: Final = Job.metadata.tables["job"]
"""Without the mapper, which costs more than what the statements of an attempt do."""
MISSED_S: Final = 0.5
"""A heartbeat may come so much late."""


class LostClaimError(ServiceError):
    """Another attempt holds the job, or it has ended: this attempt's result must be rolled back."""

    code = "lost_claim"


@dataclass(frozen=True, slots=True)
class Renewal:
    """What a heartbeat learns: whether the claim still holds, and whether the job is to be cancelled."""

    is_held: bool
    is_cancelled: bool


class Sightings:
    """Which running jobs of this machine have lost their worker, whatever its clock does meanwhile.

    A lease that has run out by the clock counts once it has not been renewed for longer than a heartbeat of real time:
    a clock that steps forward takes no job from a worker that lives. One that has not been renewed for much longer than
    a lease counts in any case: a clock that steps back leaves no job to a worker that is dead.
    """

    def __init__(self, lease_s: float, heartbeat_s: float) -> None:
        self._shortest_s = heartbeat_s + MISSED_S
        self._longest_s = lease_s + heartbeat_s + MISSED_S
        self._seen: dict[tuple[str, int], tuple[datetime | None, float]] = {}
        self._lock = threading.Lock()

    def lapsed(self, session: Session) -> ColumnElement[bool] | None:
        """Return the condition that tells the jobs whose worker is lost, None where there are none."""
        job = JOBS.c
        leases = select(job.id, job.attempts, job.lease_until, job.lease_until < DatabaseNow())
        rows = session.execute(leases.where(job.state == "running", job.lease_until.is_not(None))).all()
        now_s = time.monotonic()
        with self._lock:
            before, self._seen, lost = self._seen, {}, []
            for job_id, attempt, until, is_over in rows:
                known_until, since_s = before.get((job_id, attempt), (until, now_s))
                since_s = since_s if known_until == until else now_s
                self._seen[job_id, attempt] = until, since_s
                if now_s - since_s > (self._shortest_s if is_over else self._longest_s):
                    lost.append(job_id)
        return and_(job.state == "running", job.id.in_(lost)) if lost else None


def is_work_waiting(session: Session, lapsed: ColumnElement[bool] | None) -> bool:
    """Return whether a job waits or has lost its worker; a look that takes no lock."""
    waits = select(JOBS.c.id).where(JOBS.c.state == "queued").limit(1)
    return lapsed is not None or session.execute(waits).first() is not None


def claim_next(
    session: Session, worker: str, lease_s: float, most_lost: int, lapsed: ColumnElement[bool] | None
) -> Claim | None:
    """Return a claim on a ``lapsed`` job, or else on the one whose turn it is, if there is one."""
    if lapsed is None:
        return _claim(session, _claiming_first(lease_s), worker)
    bury_lost(session, most_lost, lapsed)
    job = JOBS.c
    held = select(job.lock).where(job.state == "running", ~lapsed, job.lock.is_not(None))
    for state in (lapsed, job.state == "queued"):
        claim = _claim(session, _claiming(_first(state, held), lease_s), worker)
        if claim is not None:
            return claim
    return None


def claim_one(session: Session, job_id: str, worker: str, lease_s: float, most_lost: int) -> Claim | None:
    """Return a claim on the job ``job_id``, unless it has ended or another attempt holds it."""
    claim = _claim(session, _claiming_one(lease_s), worker, job_id)
    if claim is None:
        bury_lost(session, most_lost, lapsed_by_clock())
        claim = _claim(session, _claiming(and_(JOBS.c.id == job_id, lapsed_by_clock()), lease_s), worker)
    return claim


def lapsed_by_clock() -> ColumnElement[bool]:
    """Return the condition that tells jobs whose lease is over by the clock of the database."""
    return and_(JOBS.c.state == "running", JOBS.c.lease_until < DatabaseNow())


def _claim(session: Session, statement: Update, worker: str, job_id: str | None = None) -> Claim | None:
    values = {"by_worker": worker} | ({} if job_id is None else {"of_job": job_id})
    row = session.execute(statement, values).first()
    return None if row is None else Claim(*row)


def _claiming(which: ColumnElement[bool], lease_s: float) -> Update:
    """Return the statement by which a worker takes the job ``which``."""
    job = JOBS.c
    claimed = update(JOBS).values(
        state="running",
        attempts=job.attempts + 1,
        lost_attempts=job.lost_attempts + case((job.state == "running", 1), else_=0),
        lease_until=DatabaseNow(lease_s),
        started_at=DatabaseNow(),
        worker=bindparam("by_worker"),
        progress=0.0,
    )
    return claimed.where(which).returning(
        job.id, job.attempts, job.kind, job.lost_attempts, job.satellite_id, job.magnetometer_id, job.request
    )


@lru_cache
def _claiming_one(lease_s: float) -> Update:
    return _claiming(and_(JOBS.c.id == bindparam("of_job"), JOBS.c.state == "queued"), lease_s)


@lru_cache
def _claiming_first(lease_s: float) -> Update:
    job = JOBS.c
    held = select(job.lock).where(job.state == "running", job.lock.is_not(None))
    return _claiming(_first(job.state == "queued", held), lease_s)


def _first(state: ColumnElement[bool], held: Select[tuple[str | None]]) -> ColumnElement[bool]:
    """Return the condition that tells the first job in ``state`` whose lock is not ``held``."""
    job = JOBS.c
    free = select(job.id).where(state, or_(job.lock.is_(None), job.lock.not_in(held)))
    return job.id == free.order_by(job.rank, job.id).limit(1).scalar_subquery()


def bury_lost(session: Session, most_lost: int, lapsed: ColumnElement[bool]) -> int:
    """Return how many ``lapsed`` jobs end here: those that lost their last worker, or were being cancelled."""
    cancelled = _end(session, and_(lapsed, JOBS.c.cancel_requested), "cancelled", None)
    why = problem(500, DEAD, f"the job lost its worker {most_lost} times; the last attempt gave no sign of life")
    dead = _end(session, and_(lapsed, JOBS.c.lost_attempts + 1 >= most_lost), "failed", why)
    return cancelled + dead


def renew(session: Session, claim: Claim, lease_s: float, progress: float) -> Renewal:
    """Prolong the lease of ``claim`` and note the job's progress."""
    cancelled = session.execute(
        update(JOBS)
        .where(_holds(claim))
        .values(lease_until=DatabaseNow(lease_s), progress=progress)
        .returning(JOBS.c.cancel_requested)
    ).scalar()
    return Renewal(cancelled is not None, bool(cancelled))


def is_cancelled(session: Session, claim: Claim) -> bool:
    """Return whether the job is to be cancelled, or is no longer the claim's."""
    wanted = session.execute(select(JOBS.c.cancel_requested).where(_holds(claim))).scalar()
    return wanted is None or wanted


def finish(
    session: Session,
    claim: Claim,
    state: str,
    error: Problem | None = None,
    result: dict[str, object] | None = None,
) -> None:
    """End the job in the session's transaction, which holds the result too.

    Raises
    ------
    LostClaimError
        The claim no longer holds; the transaction must not be committed.
    """
    held = {"of_job": claim.job_id, "of_attempt": claim.attempt}
    ended = session.execute(FINISH, held | {"to_state": state, "why": error, "found": result}).first()
    if ended is None:
        raise LostClaimError(f"attempt {claim.attempt} no longer holds job {claim.job_id}")
    if ended.parent_id is not None:
        settle(session, ended.parent_id)


def hand_back(session: Session, claim: Claim, *, is_lost: bool) -> None:
    """Let another attempt have the job; ``is_lost`` counts this one as lost."""
    session.execute(
        update(JOBS)
        .where(_holds(claim))
        .values(state="queued", lease_until=None, worker=None, lost_attempts=JOBS.c.lost_attempts + int(is_lost))
    )


def _holds(claim: Claim) -> ColumnElement[bool]:
    job = JOBS.c
    return and_(job.id == claim.job_id, job.attempts == claim.attempt, job.state == "running")


def _end(session: Session, which: ColumnElement[bool], state: str, error: Problem | None) -> int:
    ended = _ending(which).values(state=state, error=error).returning(JOBS.c.parent_id)
    parents = session.scalars(ended).all()
    for parent_id in set(parents) - {None}:
        settle(session, str(parent_id))
    return len(parents)


def _ending(which: ColumnElement[bool]) -> Update:
    return update(JOBS).where(which).values(lease_until=None, finished_at=DatabaseNow())


_HELD: Final = and_(
    JOBS.c.id == bindparam("of_job"), JOBS.c.attempts == bindparam("of_attempt"), JOBS.c.state == "running"
)
FINISH: Final = (
    _ending(_HELD)
    .values(
        state=bindparam("to_state"),
        error=bindparam("why", type_=JsonColumn),
        result=bindparam("found", type_=JsonColumn),
        progress=case((bindparam("to_state") == "succeeded", 1.0), else_=JOBS.c.progress),
    )
    .returning(JOBS.c.parent_id)
)
"""Made once: to make it costs more than to execute it."""
