"""How an attempt takes, holds and ends a job: every statement is fenced by the attempt's number.

Times are the database's own; on SQLite, whose clock is the machine's, `Sightings` guards against its steps. A lease
that ran out means that its worker is lost; the next claim takes the job over and counts the loss, and a job that lost
too many workers is dead. No job is claimed that a later release has asked for (`app.jobs.request_version`).
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Final

from sqlalchemy import ColumnElement, Select, Update, and_, bindparam, or_, select, update
from sqlalchemy.orm import Session

from app.errors import ServiceError
from app.jobs import transitions
from app.jobs.kinds.contract import Claim
from app.jobs.request_version import is_understood
from app.jobs.transitions import CANCELLED, FAILED, JOBS, QUEUED, RUNNING, end_lost
from app.problems import Problem, problem
from app.storage.database import DatabaseNow

DEAD: Final = "dead"
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
        rows = session.execute(leases.where(job.state == RUNNING, job.lease_until.is_not(None))).all()
        now_s = time.monotonic()
        with self._lock:
            before, self._seen, lost = self._seen, {}, []
            for job_id, attempt, until, is_over in rows:
                known_until, since_s = before.get((job_id, attempt), (until, now_s))
                since_s = since_s if known_until == until else now_s
                self._seen[job_id, attempt] = until, since_s
                if now_s - since_s > (self._shortest_s if is_over else self._longest_s):
                    lost.append(job_id)
        return and_(job.state == RUNNING, job.id.in_(lost)) if lost else None


def is_work_waiting(session: Session, lapsed: ColumnElement[bool] | None) -> bool:
    """Return whether a job waits or has lost its worker; a look that takes no lock."""
    waits = select(JOBS.c.id).where(JOBS.c.state == QUEUED, is_understood()).limit(1)
    return lapsed is not None or session.execute(waits).first() is not None


def claim_next(
    session: Session, worker: str, lease_s: float, most_lost: int, lapsed: ColumnElement[bool] | None
) -> Claim | None:
    """Return a claim on a ``lapsed`` job, or else on the one whose turn it is, if there is one."""
    if lapsed is None:
        return _claim(session, _claiming_first(lease_s), worker)
    bury_lost(session, most_lost, lapsed)
    job = JOBS.c
    held = select(job.lock).where(job.state == RUNNING, ~lapsed, job.lock.is_not(None))
    for begin, which in ((RUNNING, lapsed), (QUEUED, job.state == QUEUED)):
        claim = _claim(session, _claiming(begin, _first(which, held), lease_s), worker)
        if claim is not None:
            return claim
    return None


def claim_one(session: Session, job_id: str, worker: str, lease_s: float, most_lost: int) -> Claim | None:
    """Return a claim on the job ``job_id``, unless it has ended or another attempt holds it."""
    claim = _claim(session, _claiming_one(lease_s), worker, job_id)
    if claim is None:
        bury_lost(session, most_lost, lapsed_by_clock())
        claim = _claim(session, _claiming(RUNNING, and_(JOBS.c.id == job_id, lapsed_by_clock()), lease_s), worker)
    return claim


def lapsed_by_clock() -> ColumnElement[bool]:
    """Return the condition that tells jobs whose lease is over by the clock of the database."""
    return and_(JOBS.c.state == RUNNING, JOBS.c.lease_until < DatabaseNow())


def _claim(session: Session, statement: Update, worker: str, job_id: str | None = None) -> Claim | None:
    values = {"by_worker": worker} | ({} if job_id is None else {"of_job": job_id})
    row = session.execute(statement, values).first()
    return None if row is None else Claim(*row)


def _claiming(begin: str, which: ColumnElement[bool], lease_s: float) -> Update:
    """Return the statement by which a worker takes the job ``which`` that is in state ``begin``."""
    job = JOBS.c
    return transitions.claiming(begin, and_(which, is_understood()), lease_s).returning(
        job.id, job.attempts, job.kind, job.lost_attempts, job.satellite_id, job.magnetometer_id, job.request
    )


@lru_cache
def _claiming_one(lease_s: float) -> Update:
    return _claiming(QUEUED, JOBS.c.id == bindparam("of_job"), lease_s)


@lru_cache
def _claiming_first(lease_s: float) -> Update:
    job = JOBS.c
    held = select(job.lock).where(job.state == RUNNING, job.lock.is_not(None))
    return _claiming(QUEUED, _first(job.state == QUEUED, held), lease_s)


def _first(state: ColumnElement[bool], held: Select[tuple[str | None]]) -> ColumnElement[bool]:
    """Return the condition that tells the first job in ``state`` whose lock is not ``held``."""
    job = JOBS.c
    free = select(job.id).where(state, is_understood(), or_(job.lock.is_(None), job.lock.not_in(held)))
    return job.id == free.order_by(job.rank, job.id).limit(1).scalar_subquery()


def bury_lost(session: Session, most_lost: int, lapsed: ColumnElement[bool]) -> int:
    """Return how many ``lapsed`` jobs end here: those that lost their last worker, or were being cancelled."""
    cancelled = end_lost(session, and_(lapsed, JOBS.c.cancel_requested), CANCELLED, None)
    why = problem(500, DEAD, f"the job lost its worker {most_lost} times; the last attempt gave no sign of life")
    dead = end_lost(session, and_(lapsed, JOBS.c.lost_attempts + 1 >= most_lost), FAILED, why)
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


def require_held(session: Session, claim: Claim) -> None:
    """Hold the job for the transaction, which is about to keep what its attempt has found.

    Raises
    ------
    LostClaimError
        The claim no longer holds; nothing must be kept.
    """
    held = select(JOBS.c.id).where(_holds(claim)).with_for_update(key_share=True)
    if session.execute(held).first() is None:
        raise LostClaimError(f"attempt {claim.attempt} no longer holds job {claim.job_id}")


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
    if not transitions.finish(session, claim.job_id, claim.attempt, state, error=error, result=result):
        raise LostClaimError(f"attempt {claim.attempt} no longer holds job {claim.job_id}")


def hand_back(session: Session, claim: Claim, *, is_lost: bool) -> None:
    """Let another attempt have the job; ``is_lost`` counts this one as lost.

    Raises
    ------
    LostClaimError
        The claim no longer holds: the job is another attempt's, or has ended, and must not be handed out again.
    """
    if not transitions.hand_back(session, _holds(claim), is_lost=is_lost):
        raise LostClaimError(f"attempt {claim.attempt} no longer holds job {claim.job_id}")


def _holds(claim: Claim) -> ColumnElement[bool]:
    job = JOBS.c
    return and_(job.id == claim.job_id, job.attempts == claim.attempt, job.state == RUNNING)
