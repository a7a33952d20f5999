"""How many jobs of one key may wait."""

from __future__ import annotations

import hashlib

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.errors import QuotaError
from app.jobs.tables import Job


def check_quota(session: Session, caller: Caller, most_queued: int, wanted: int) -> None:
    """Refuse ``wanted`` further jobs where more than ``most_queued`` of the caller's key would wait.

    The count holds for the transaction: on PostgreSQL, another one of the same key waits until this has ended.

    Raises
    ------
    QuotaError
        They would be too many.
    """
    if session.get_bind().dialect.name == "postgresql":
        lock = int.from_bytes(hashlib.sha256(f"quota {caller.key_id}".encode()).digest()[:8], signed=True)
        session.execute(select(func.pg_advisory_xact_lock(lock)))
    waiting = select(func.count()).where(Job.created_by == caller.key_id, Job.state == "queued")
    used = session.scalar(waiting) or 0
    if used + wanted > most_queued:
        raise QuotaError("jobs of this key that wait", most_queued, used, reset_s=60)
