"""Who wants to know that jobs have ended is told here, in the transaction that ended them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.jobs.tables import Job
from app.outbox.events import job_ended
from app.outbox.log import append

JOB: Final = Job.metadata.tables["job"].c
ENDED: Final = select(
    JOB.id.label("job_id"), JOB.kind, JOB.state, JOB.satellite_id, JOB.magnetometer_id, JOB.result, JOB.error,
    JOB.parent_id, JOB.created_by.label("owner"),
)  # fmt: skip
IDS_AT_ONCE: Final = 500


def tell_ended(session: Session, job_ids: Sequence[str]) -> None:
    """Write into the log of what happened that the jobs ``job_ids`` have ended."""
    connection = session.connection()
    for start in range(0, len(job_ids), IDS_AT_ONCE):
        part = job_ids[start : start + IDS_AT_ONCE]
        which = JOB.id == part[0] if len(part) == 1 else JOB.id.in_(part)
        append(
            session, [job_ended(**row) for row in connection.execute(ENDED.where(which).order_by(JOB.id)).mappings()]
        )
