"""Table of notes: what somebody wrote beside a satellite, a magnetometer, a session or a parameter set."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base


class Note(Base):
    """A text with its author and time; it belongs to the satellite that its subject is of."""

    __tablename__ = "note"
    __table_args__ = (
        CheckConstraint("kind IN ('satellite', 'magnetometer', 'session', 'parameter_set')", name="kind"),
        Index(None, "satellite_id", "id"),
        Index(None, "kind", "subject", "id"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    kind: Mapped[str] = mapped_column(String(16))
    subject: Mapped[str] = mapped_column(String(130))
    satellite_id: Mapped[str] = mapped_column(ForeignKey("satellite.id"))
    text: Mapped[str] = mapped_column(String(4000))
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))
