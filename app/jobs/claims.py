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
from typing import Final

from sqlalchemy import ColumnElement, and_, case, or_, select, update
from sqlalchemy.orm import Session

from app.database import DatabaseNow
from app.errors import Problem, ServiceError, problem
from app.jobs.reprocessing import settle
from app.jobs.tables import Job

DEAD: Final = "dead"
MISSED_S: Final = 0.5
"""A heartbeat may come so much late."""


class LostClaimError(ServiceError):
    """Another attempt holds the job, or it has ended: this attempt's result must be rolled back."""

    code = "lost_claim"


@dataclass(frozen=True, slots=True)
class Claim:
    """The right of one attempt to work on one job."""

    job_id: str
    attempt: int
    kind: str


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

    def lapsed(self, session: Session) -> ColumnElement[bool]:
        """Return the condition that tells the jobs whose worker is lost."""
        leases = select(Job.id, Job.attempts, Job.lease_until, Job.lease_until < DatabaseNow())
        rows = session.execute(leases.where(Job.state == "running", Job.lease_until.is_not(None))).all()
        now_s = time.monotonic()
        with self._lock:
            before, self._seen, lost = self._seen, {}, []
            for job_id, attempt, until, is_over in rows:
                known_until, since_s = before.get((job_id, attempt), (until, now_s))
                since_s = since_s if known_until == until else now_s
                self._seen[job_id, attempt] = until, since_s
                if now_s - since_s > (self._shortest_s if is_over else self._longest_s):
                    lost.append(job_id)
        return and_(Job.state == "running", Job.id.in_(lost))


def is_work_waiting(session: Session, lapsed: ColumnElement[bool]) -> bool:
    """Return whether a job waits or has lost its worker; a look that takes no lock."""
    return session.scalar(select(Job.id).where(or_(Job.state == "queued", lapsed)).limit(1)) is not None


def claim_next(
    session: Session, worker: str, lease_s: float, most_lost: int, lapsed: ColumnElement[bool]
) -> Claim | None:
    """Return a claim on a ``lapsed`` job, or else on the one whose turn it is, if there is one."""
    bury_lost(session, most_lost, lapsed)
    held = select(Job.lock).where(Job.state == "running", ~lapsed, Job.lock.is_not(None))
    for state in (lapsed, Job.state == "queued"):
        free = select(Job.id).where(state, or_(Job.lock.is_(None), Job.lock.not_in(held)))
        first = free.order_by(Job.rank, Job.id).limit(1).scalar_subquery()
        claim = _claim(session, Job.id == first, worker, lease_s)
        if claim is not None:
            return claim
    return None


def claim_one(session: Session, job_id: str, worker: str, lease_s: float, most_lost: int) -> Claim | None:
    """Return a claim on the job ``job_id``, unless it has ended or another attempt holds it."""
    claim = _claim(session, and_(Job.id == job_id, Job.state == "queued"), worker, lease_s)
    if claim is None:
        bury_lost(session, most_lost, lapsed_by_clock())
        claim = _claim(session, and_(Job.id == job_id, lapsed_by_clock()), worker, lease_s)
    return claim


def lapsed_by_clock() -> ColumnElement[bool]:
    """Return the condition that tells jobs whose lease is over by the clock of the database."""
    return and_(Job.state == "running", Job.lease_until < DatabaseNow())


def _claim(session: Session, which: ColumnElement[bool], worker: str, lease_s: float) -> Claim | None:
    row = session.execute(
        update(Job)
        .where(which)
        .values(
            state="running",
            attempts=Job.attempts + 1,
            lost_attempts=Job.lost_attempts + case((Job.state == "running", 1), else_=0),
            lease_until=DatabaseNow(lease_s),
            started_at=DatabaseNow(),
            worker=worker,
            progress=0.0,
        )
        .returning(Job.id, Job.attempts, Job.kind)
        .execution_options(synchronize_session=False)
    ).first()
    return None if row is None else Claim(*row)


def bury_lost(session: Session, most_lost: int, lapsed: ColumnElement[bool]) -> int:
    """Return how many ``lapsed`` jobs end here: those that lost their last worker, or were being cancelled."""
    cancelled = _end(session, and_(lapsed, Job.cancel_requested), "cancelled", None, None)
    why = problem(500, DEAD, f"the job lost its worker {most_lost} times; the last attempt gave no sign of life")
    dead = _end(session, and_(lapsed, Job.lost_attempts + 1 >= most_lost), "failed", why, None)
    return cancelled + dead


def renew(session: Session, claim: Claim, lease_s: float, progress: float) -> Renewal:
    """Prolong the lease of ``claim`` and note the job's progress."""
    cancelled = session.execute(
        update(Job)
        .where(_holds(claim))
        .values(lease_until=DatabaseNow(lease_s), progress=progress)
        .returning(Job.cancel_requested)
        .execution_options(synchronize_session=False)
    ).scalar()
    return Renewal(cancelled is not None, bool(cancelled))


def is_cancelled(session: Session, claim: Claim) -> bool:
    """Return whether the job is to be cancelled, or is no longer the claim's."""
    wanted = session.execute(select(Job.cancel_requested).where(_holds(claim))).scalar()
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
    if not _end(session, _holds(claim), state, error, result):
        raise LostClaimError(f"attempt {claim.attempt} no longer holds job {claim.job_id}")


def hand_back(session: Session, claim: Claim, *, is_lost: bool) -> None:
    """Let another attempt have the job; ``is_lost`` counts this one as lost."""
    session.execute(
        update(Job)
        .where(_holds(claim))
        .values(state="queued", lease_until=None, worker=None, lost_attempts=Job.lost_attempts + int(is_lost))
        .execution_options(synchronize_session=False)
    )


def _holds(claim: Claim) -> ColumnElement[bool]:
    return and_(Job.id == claim.job_id, Job.attempts == claim.attempt, Job.state == "running")


def _end(
    session: Session,
    which: ColumnElement[bool],
    state: str,
    error: Problem | None,
    result: dict[str, object] | None,
) -> int:
    values: dict[str, object] = {
        "state": state,
        "error": error,
        "result": result,
        "lease_until": None,
        "finished_at": DatabaseNow(),
    }
    if state == "succeeded":
        values["progress"] = 1.0
    ended = update(Job).where(which).values(values).returning(Job.parent_id)
    parents = session.scalars(ended.execution_options(synchronize_session=False)).all()
    for parent_id in set(parents) - {None}:
        settle(session, str(parent_id))
    return len(parents)
