"""Series that a job leaves beside its result: one table in the store."""

from __future__ import annotations

from typing import Final

from sqlalchemy.orm import Session

from app.errors import NotFoundError
from app.jobs.tables import Job
from app.records.arrow import from_bytes
from app.storage.store import Store, series_key

SERIES_POINTS: Final = 2000
"""Most rows of a job's series."""


def keep_series(session: Session, store: Store, job_id: str, content: bytes) -> dict[str, object]:
    """Keep a job's series, a table as `to_bytes` writes it, and return what the job's result says of it."""
    table = from_bytes(content)
    return {
        "sha256": store.put(session, series_key(job_id), content),
        "rows": table.num_rows,
        "columns": table.column_names,
        "href": f"/api/v1/jobs/{job_id}/series",
    }


def read_series(session: Session, store: Store, job: Job) -> bytes:
    """Return a job's series as it was kept.

    Raises
    ------
    NotFoundError
        The job has none: it has not succeeded, or its kind leaves none.
    """
    kept = (job.result or {}).get("series")
    if not isinstance(kept, dict):
        raise NotFoundError("the job has no series")
    return store.get(session, series_key(job.id), str(kept["sha256"]))
