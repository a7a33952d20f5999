"""How a job goes from one state to another, and who is told of its end: no other module writes a job's state.

    queued  -> running                          an attempt claims it
    running -> running                          another attempt takes it over from a worker that is lost
    running -> queued                           its attempt hands it back
    running -> succeeded | failed | cancelled   its attempt ends it, or its worker is lost for the last time
    queued  -> cancelled                        somebody cancels it before it began

A job begins as queued. One that sums others up begins as running, no worker takes it, and it ends with the last of
them. What has ended stays as it is. An end is told in the transaction that makes it so: to the log of what happened,
which webhooks, messages and streams follow, and to the job that sums it up. How long attempts take is measured where
they are made (`app.jobs.execution.attempt`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from sqlalchemy import ColumnElement, Update, and_, bindparam, case, exists, func, select, update
from sqlalchemy.orm import Session

from app.errors import ServiceError
from app.jobs.request_version import REQUEST_VERSION
from app.jobs.tables import Job
from app.outbox.events import job_ended
from app.outbox.log import append
from app.problems import Problem
from app.storage.database import DatabaseNow, JsonColumn, new_id, utc_now

QUEUED: Final = "queued"
RUNNING: Final = "running"
SUCCEEDED: Final = "succeeded"
FAILED: Final = "failed"
CANCELLED: Final = "cancelled"
UNENDED: Final = (QUEUED, RUNNING)
ENDED: Final = frozenset({SUCCEEDED, FAILED, CANCELLED})
ALLOWED: Final = frozenset(
    {(QUEUED, RUNNING), (RUNNING, RUNNING), (RUNNING, QUEUED), (QUEUED, CANCELLED)} | {(RUNNING, end) for end in ENDED}
)

JOBS: Final = Job.metadata.tables["job"]
"""Without the mapper, which costs more than what the statements of an attempt do."""
TOLD: Final = select(
    JOBS.c.id.label("job_id"), JOBS.c.kind, JOBS.c.state, JOBS.c.satellite_id, JOBS.c.magnetometer_id, JOBS.c.result,
    JOBS.c.error, JOBS.c.parent_id, JOBS.c.created_by.label("owner"),
)  # fmt: skip
IDS_AT_ONCE: Final = 500


class TransitionError(ServiceError):
    """A job was to go where it cannot from its state."""

    code = "internal"


def new_job(
    kind: str,
    priority: int,
    request: dict[str, object],
    created_by: str,
    *,
    is_sum: bool = False,
    **places: str | None,
) -> Job:
    """Return a job that waits, or one that sums others up and runs at once; ``places`` are columns of its own."""
    now = utc_now()
    return Job(
        id=new_id(),
        kind=kind,
        state=RUNNING if is_sum else QUEUED,
        priority=priority,
        request=request,
        request_version=REQUEST_VERSION,
        progress=0.0,
        attempts=0,
        lost_attempts=0,
        cancel_requested=False,
        created_at=now,
        created_by=created_by,
        started_at=now if is_sum else None,
        **places,
    )


def claiming(begin: str, which: ColumnElement[bool], lease_s: float) -> Update:
    """Return the statement by which the worker ``by_worker`` takes the job ``which`` that is in state ``begin``.

    One that runs already is taken over from a worker that is lost, and the loss is counted.
    """
    claimed = _moving(begin, RUNNING).values(
        attempts=JOBS.c.attempts + 1,
        lease_until=DatabaseNow(lease_s),
        started_at=DatabaseNow(),
        worker=bindparam("by_worker"),
        progress=0.0,
    )
    lost = claimed.values(lost_attempts=JOBS.c.lost_attempts + 1) if begin == RUNNING else claimed
    return lost.where(which)


def hand_back(session: Session, held: ColumnElement[bool], *, is_lost: bool) -> bool:
    """Let another attempt have the job that is ``held``; ``is_lost`` counts this one as lost. Return whether it was."""
    handed_back = (
        _moving(RUNNING, QUEUED)
        .where(held)
        .values(lease_until=None, worker=None, lost_attempts=JOBS.c.lost_attempts + int(is_lost))
        .returning(JOBS.c.id)
    )
    return session.execute(handed_back).first() is not None


def finish(
    session: Session,
    job_id: str,
    attempt: int,
    state: str,
    *,
    error: Problem | None,
    result: dict[str, object] | None,
) -> bool:
    """End the job that ``attempt`` holds, and return whether it did hold it."""
    _check(RUNNING, state, ENDED)
    values = {"of_job": job_id, "of_attempt": attempt, "to_state": state, "why": error, "found": result}
    ended = session.execute(FINISH, values).first()
    if ended is None:
        return False
    _tell_all(session, [(job_id, ended.parent_id)])
    return True


def end_lost(session: Session, lapsed: ColumnElement[bool], state: str, error: Problem | None) -> int:
    """End the jobs that run and whose worker is lost, and return how many there were."""
    _check(RUNNING, state, ENDED)
    ended = session.execute(
        _ending(_moving(RUNNING, state)).where(lapsed).values(error=error).returning(JOBS.c.id, JOBS.c.parent_id)
    ).all()
    _tell_all(session, ended)
    return len(ended)


def cancel(session: Session, job_id: str) -> None:
    """Cancel the job where it waits; where it runs, ask its attempt to end."""
    _tell_all(session, _cancelled(session, QUEUED, JOBS.c.id == job_id))
    _ask_to_end(session, JOBS.c.id == job_id)


def cancel_sum(session: Session, parent_id: str) -> None:
    """Cancel what waits of a reprocessing and ask what runs to stop; the request itself is cancelled at once.

    Its children are locked first, lest one is claimed or handed back between the two statements and missed by both.
    """
    child = JOBS.c.parent_id == parent_id
    unended = select(Job.id).where(child, Job.state.in_(UNENDED))
    session.execute(unended.order_by(Job.id).with_for_update(key_share=True))
    _tell_log(session, [job_id for job_id, _ in _cancelled(session, QUEUED, child)])
    _ask_to_end(session, child)
    _tell_log(session, [job_id for job_id, _ in _cancelled(session, RUNNING, JOBS.c.id == parent_id)])


def settle(session: Session, parent_id: str) -> None:
    """End a reprocessing whose last calibration has ended; its result says how they ended.

    The parent is locked before its children are counted: of two children that end at once, the second to have the lock
    sees that the first has ended. Whoever locks a child and its parent takes the child first.
    """
    session.execute(select(Job.id).where(Job.id == parent_id).with_for_update(key_share=True))
    unended = select(Job.id).where(Job.parent_id == parent_id, Job.state.in_(UNENDED))
    if session.scalar(select(exists(unended))):
        return
    result = dict.fromkeys((SUCCEEDED, FAILED, CANCELLED), 0) | counts_of(session, parent_id)
    ended = session.scalars(
        _ending(_moving(RUNNING, SUCCEEDED))
        .where(JOBS.c.id == parent_id)
        .values(progress=1.0, result=result)
        .returning(JOBS.c.id)
    ).all()
    _tell_log(session, ended)


def counts_of(session: Session, parent_id: str) -> dict[str, int]:
    """Return how many of the jobs that another sums up are in each state."""
    states = select(Job.state, func.count()).where(Job.parent_id == parent_id).group_by(Job.state)
    return {str(state): int(count) for state, count in session.execute(states)}


def _check(begin: str, end: str, among: Iterable[str] = (*UNENDED, *ENDED)) -> None:
    if (begin, end) not in ALLOWED or end not in among:
        raise TransitionError(f"a job that is {begin} does not become {end}")


def _moving(begin: str, end: str) -> Update:
    """Return the statement that takes jobs from one state to another, and touches none that is in a third."""
    _check(begin, end)
    return update(JOBS).where(JOBS.c.state == begin).values(state=end)


def _ending(moving: Update) -> Update:
    return moving.values(lease_until=None, finished_at=DatabaseNow())


def _cancelled(session: Session, begin: str, which: ColumnElement[bool]) -> Sequence[tuple[str, str | None]]:
    """Cancel the jobs ``which`` that are in state ``begin``, and return the id and the parent's of each."""
    statement = _ending(_moving(begin, CANCELLED)).where(which).values(cancel_requested=True)
    rows = session.execute(statement.returning(JOBS.c.id, JOBS.c.parent_id)).all()
    return [(job_id, parent_id) for job_id, parent_id in rows]


def _ask_to_end(session: Session, which: ColumnElement[bool]) -> None:
    session.execute(update(JOBS).where(which, JOBS.c.state == RUNNING).values(cancel_requested=True))


def _tell_all(session: Session, ended: Iterable[Sequence[str | None]]) -> None:
    """Tell whoever wants to know that jobs, each given by its id and its parent's, have ended."""
    found = list(ended)
    _tell_log(session, [str(job_id) for job_id, _ in found])
    parents = {str(parent_id) for _, parent_id in found if parent_id is not None}
    for parent_id in sorted(parents):  # one order, lest two lock crosswise
        settle(session, parent_id)


def _tell_log(session: Session, job_ids: Sequence[str]) -> None:
    """Write into the log of what happened that the jobs ``job_ids`` have ended."""
    connection = session.connection()
    for start in range(0, len(job_ids), IDS_AT_ONCE):
        part = job_ids[start : start + IDS_AT_ONCE]
        which = JOBS.c.id == part[0] if len(part) == 1 else JOBS.c.id.in_(part)
        rows = connection.execute(TOLD.where(which).order_by(JOBS.c.id)).mappings()
        append(session, [job_ended(**row) for row in rows])


_HELD: Final = and_(
    JOBS.c.id == bindparam("of_job"), JOBS.c.attempts == bindparam("of_attempt"), JOBS.c.state == RUNNING
)
FINISH: Final = (
    _ending(update(JOBS).where(_HELD))
    .values(
        state=bindparam("to_state"),
        error=bindparam("why", type_=JsonColumn),
        result=bindparam("found", type_=JsonColumn),
        progress=case((bindparam("to_state") == SUCCEEDED, 1.0), else_=JOBS.c.progress),
    )
    .returning(JOBS.c.parent_id)
)
"""Made once: to make it costs more than to execute it."""
