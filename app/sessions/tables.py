"""Tables of telemetry: sessions, and the chunks of bytes that they came in."""

from __future__ import annotations

from datetime import datetime
from typing import Final

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    String,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn

KEPT: Final = text("raw_removed_at IS NULL AND state = 'closed'")
"""What retention looks among."""


class TelemetrySession(Base):
    """Telemetry of one magnetometer: one upload, or an open session filled chunk by chunk."""

    __tablename__ = "session"
    __table_args__ = (
        ForeignKeyConstraint(["satellite_id", "magnetometer_id"], ["magnetometer.satellite_id", "magnetometer.id"]),
        UniqueConstraint("satellite_id", "magnetometer_id", "sha256"),
        CheckConstraint("state IN ('open', 'closed')", name="state"),
        Index(None, "satellite_id", "data_from"),
        Index(None, "satellite_id", "id"),
        Index(None, "satellite_id", "magnetometer_id", "id"),
        Index(None, "satellite_id", "magnetometer_id", "data_until"),
        Index("ix_session_kept", "satellite_id", "data_until", sqlite_where=KEPT, postgresql_where=KEPT),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(String(63))
    magnetometer_id: Mapped[str] = mapped_column(String(63))
    state: Mapped[str] = mapped_column(String(8))
    sha256: Mapped[str | None] = mapped_column(String(64))
    size_bytes: Mapped[int] = mapped_column(BigInteger)
    samples: Mapped[int]
    used_samples: Mapped[int]
    data_from: Mapped[datetime | None]
    data_until: Mapped[datetime | None]
    columns: Mapped[list[str]] = mapped_column(JsonColumn)
    quality: Mapped[dict[str, object]] = mapped_column(JsonColumn)
    raw_removed_at: Mapped[datetime | None]
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))
    closed_at: Mapped[datetime | None]


class SessionMonitoring(Base):
    """What a session says of the parameter set that was in force when it was judged last; nothing is refitted."""

    __tablename__ = "session_monitoring"
    __table_args__ = (
        CheckConstraint("grade IN ('agrees', 'watch', 'disagrees', 'too_short', 'not_judged')", name="grade"),
    )

    session_id: Mapped[str] = mapped_column(ForeignKey("session.id"), primary_key=True)
    parameter_set_id: Mapped[str] = mapped_column(String(32))
    grade: Mapped[str] = mapped_column(String(16))
    residual_rms_nt: Mapped[float | None]
    residual_ratio: Mapped[float | None]
    record: Mapped[dict[str, object]] = mapped_column(JsonColumn)
    judged_at: Mapped[datetime]


class Chunk(Base):
    """Bytes as they arrived, and their columnar form."""

    __tablename__ = "chunk"
    __table_args__ = (UniqueConstraint("session_id", "sha256"), Index(None, "created_at"))

    session_id: Mapped[str] = mapped_column(ForeignKey("session.id"), primary_key=True)
    sequence: Mapped[int] = mapped_column(primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64))
    size_bytes: Mapped[int] = mapped_column(BigInteger)
    format: Mapped[str] = mapped_column(String(16))
    media_type: Mapped[str] = mapped_column(String(200))
    samples: Mapped[int]
    columns_sha256: Mapped[str] = mapped_column(String(64))
    reading: Mapped[dict[str, object] | None] = mapped_column(JsonColumn)
    created_at: Mapped[datetime]
