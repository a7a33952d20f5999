"""Tables of what needs somebody's attention: who has seen it, and what the log of what happened has been told."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKeyConstraint, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base


class AttentionRaised(Base):
    """An entry that the log has been told of and that has not gone since."""

    __tablename__ = "attention_raised"
    __table_args__ = (
        ForeignKeyConstraint(["satellite_id", "magnetometer_id"], ["magnetometer.satellite_id", "magnetometer.id"]),
        CheckConstraint("severity IN ('act', 'watch')", name="severity"),
        Index(None, "satellite_id", "magnetometer_id"),
    )

    entry_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(String(63))
    magnetometer_id: Mapped[str] = mapped_column(String(63))
    code: Mapped[str] = mapped_column(String(32))
    severity: Mapped[str] = mapped_column(String(8))
    raised_at: Mapped[datetime]


class AttentionAcknowledgement(Base):
    """Somebody has seen an entry; it holds for what the entry was about then, at that severity."""

    __tablename__ = "attention_acknowledgement"
    __table_args__ = (
        ForeignKeyConstraint(["satellite_id", "magnetometer_id"], ["magnetometer.satellite_id", "magnetometer.id"]),
        CheckConstraint("severity IN ('act', 'watch')", name="severity"),
        Index(None, "satellite_id"),
    )

    entry_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(String(63))
    magnetometer_id: Mapped[str] = mapped_column(String(63))
    about: Mapped[str] = mapped_column(String(200))
    severity: Mapped[str] = mapped_column(String(8))
    note: Mapped[str] = mapped_column(String(2000))
    until: Mapped[datetime | None]
    at: Mapped[datetime]
    by: Mapped[str | None] = mapped_column(String(32))


class SetLife(Base):
    """Until when a magnetometer's set in force is good by the trend of its sets, for the sets that there were then."""

    __tablename__ = "set_life"
    __table_args__ = (
        ForeignKeyConstraint(["satellite_id", "magnetometer_id"], ["magnetometer.satellite_id", "magnetometer.id"]),
    )

    satellite_id: Mapped[str] = mapped_column(String(63), primary_key=True)
    magnetometer_id: Mapped[str] = mapped_column(String(63), primary_key=True)
    parameter_set_id: Mapped[str] = mapped_column(String(32))
    newest_set_id: Mapped[str] = mapped_column(String(32))
    until: Mapped[datetime | None]
    share: Mapped[float]
    is_capped: Mapped[bool]
