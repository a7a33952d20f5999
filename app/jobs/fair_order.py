"""Whose turn it is: jobs of one priority are taken in rounds, one of each satellite, each satellite's in their order.

A job's rank is its place in the queue, the smallest first: its priority, then its round. A job joins the round that is
being worked on, or the one after its satellite's last that waits, so that a satellite with a thousand jobs delays
another's next job by one job and not by a thousand. No worker has to look at more than the head of the queue for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.jobs.tables import Job

ROUNDS: Final = 10_000_000
"""Rounds of one priority. Past the last, jobs stand in the order of their arrival; an empty queue begins anew.

201 priorities of so many are ranks of 32 bits, which is what procrastinate has for its priorities.
"""


def take_turns(session: Session, jobs: Sequence[Job]) -> None:
    """Give each of the new ``jobs`` its rank."""
    next_ranks: dict[tuple[int, str | None], int] = {}
    for job in jobs:
        place = job.priority, job.satellite_id
        if place not in next_ranks:
            next_ranks[place] = _next_rank(session, *place)
        job.rank = min(next_ranks[place], _first_rank(job.priority) + ROUNDS - 1)
        next_ranks[place] += 1


def _first_rank(priority: int) -> int:
    return -priority * ROUNDS


def _next_rank(session: Session, priority: int, satellite_id: str | None) -> int:
    """Return the rank of the next job of a satellite; all jobs without one count as one satellite's."""
    first = _first_rank(priority)
    level = Job.rank.between(first, first + ROUNDS - 1)
    now = session.scalar(select(func.min(Job.rank)).where(Job.state == "queued", level))
    own = Job.satellite_id.is_(None) if satellite_id is None else Job.satellite_id == satellite_id
    last = session.scalar(select(func.max(Job.rank)).where(Job.state == "queued", own, level))
    return max(first if now is None else now, first if last is None else last + 1)
