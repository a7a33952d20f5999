"""Tables of the queue: a job is a row, and only the attempt that holds it may finish it."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import BigInteger, CheckConstraint, ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class Job(Base):
    """One piece of work."""

    __tablename__ = "job"
    __table_args__ = (
        CheckConstraint("state IN ('queued', 'running', 'succeeded', 'failed', 'cancelled')", name="state"),
        CheckConstraint("progress >= 0 AND progress <= 1", name="progress"),
        Index(None, "state", "rank", "id"),
        Index(None, "satellite_id", "state", "rank"),
        Index(None, "state", "id"),
        Index(None, "created_by", "state"),
        Index(None, "satellite_id", "id"),
        Index(None, "satellite_id", "magnetometer_id", "id"),
        Index(None, "parent_id", "state"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    state: Mapped[str] = mapped_column(String(16))
    priority: Mapped[int]
    rank: Mapped[int] = mapped_column(server_default="0")
    satellite_id: Mapped[str | None] = mapped_column(ForeignKey("satellite.id"))
    magnetometer_id: Mapped[str | None] = mapped_column(String(63))
    parent_id: Mapped[str | None] = mapped_column(ForeignKey("job.id"))
    lock: Mapped[str | None] = mapped_column(String(130))
    request: Mapped[dict[str, object]] = mapped_column(JsonColumn)
    request_version: Mapped[int] = mapped_column(server_default="1")
    progress: Mapped[float]
    attempts: Mapped[int]
    lost_attempts: Mapped[int]
    cancel_requested: Mapped[bool]
    lease_until: Mapped[datetime | None]
    worker: Mapped[str | None] = mapped_column(String(200))
    queue_id: Mapped[int | None] = mapped_column(BigInteger)
    error: Mapped[dict[str, object] | None] = mapped_column(JsonColumn)
    result: Mapped[dict[str, object] | None] = mapped_column(JsonColumn)
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]


class JobSession(Base):
    """Which sessions a job works on."""

    __tablename__ = "job_session"

    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"), primary_key=True)
    session_id: Mapped[str] = mapped_column(ForeignKey("session.id"), primary_key=True, index=True)
