"""Table of orbits: one row an element set, ephemeris or state vector."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, Index, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class OrbitRow(Base):
    """One source of position, with the text that it came as."""

    __tablename__ = "orbit"
    __table_args__ = (
        UniqueConstraint("satellite_id", "sha256"),
        CheckConstraint("format IN ('tle', 'omm', 'oem', 'state')", name="format"),
        Index(None, "satellite_id", "epoch", "id"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(ForeignKey("satellite.id"))
    format: Mapped[str] = mapped_column(String(8))
    name: Mapped[str | None] = mapped_column(String(200))
    epoch: Mapped[datetime]
    until: Mapped[datetime | None]
    content: Mapped[str] = mapped_column(Text)
    sha256: Mapped[str] = mapped_column(String(64))
    details: Mapped[dict[str, object]] = mapped_column(JsonColumn)
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))
