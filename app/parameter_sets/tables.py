"""Tables of results: parameter sets, which never change but for their status, and the history of what was in force."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, ForeignKeyConstraint, Index, String, text
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class ParameterSet(Base):
    """The result of one calibration."""

    __tablename__ = "parameter_set"
    __table_args__ = (
        ForeignKeyConstraint(["satellite_id", "magnetometer_id"], ["magnetometer.satellite_id", "magnetometer.id"]),
        CheckConstraint("status IN ('candidate', 'active', 'retired')", name="status"),
        CheckConstraint("grade IN ('accept', 'weak', 'refuse')", name="grade"),
        Index(None, "satellite_id", "id"),
        Index(None, "satellite_id", "magnetometer_id", "id"),
        Index(
            "ux_parameter_set_active",
            "satellite_id",
            "magnetometer_id",
            unique=True,
            sqlite_where=text("status = 'active'"),
            postgresql_where=text("status = 'active'"),
        ),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(String(63))
    magnetometer_id: Mapped[str] = mapped_column(String(63))
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"), unique=True)
    status: Mapped[str] = mapped_column(String(16))
    grade: Mapped[str] = mapped_column(String(8))
    method: Mapped[str] = mapped_column(String(32))
    data_from: Mapped[datetime]
    data_until: Mapped[datetime]
    record: Mapped[dict[str, object]] = mapped_column(JsonColumn)
    residuals_sha256: Mapped[str] = mapped_column(String(64))
    moments_sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime]


class ParameterSetSession(Base):
    """Which sessions a parameter set was calibrated from."""

    __tablename__ = "parameter_set_session"

    parameter_set_id: Mapped[str] = mapped_column(ForeignKey("parameter_set.id"), primary_key=True)
    session_id: Mapped[str] = mapped_column(ForeignKey("session.id"), primary_key=True, index=True)


class Activation(Base):
    """A span of time in which a parameter set was in force."""

    __tablename__ = "activation"
    __table_args__ = (
        ForeignKeyConstraint(["satellite_id", "magnetometer_id"], ["magnetometer.satellite_id", "magnetometer.id"]),
        Index(None, "satellite_id", "magnetometer_id", "begun_at"),
        Index(None, "parameter_set_id"),
        Index(
            "ux_activation_open",
            "satellite_id",
            "magnetometer_id",
            unique=True,
            sqlite_where=text("ended_at IS NULL"),
            postgresql_where=text("ended_at IS NULL"),
        ),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(String(63))
    magnetometer_id: Mapped[str] = mapped_column(String(63))
    parameter_set_id: Mapped[str] = mapped_column(ForeignKey("parameter_set.id"))
    previous_id: Mapped[str | None] = mapped_column(ForeignKey("activation.id"))
    begun_at: Mapped[datetime]
    ended_at: Mapped[datetime | None]
    begun_by: Mapped[str | None] = mapped_column(String(32))
