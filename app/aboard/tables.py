"""Table of what is known to be aboard: each step of a parameter set on its way into orbit."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class AboardReport(Base):
    """Somebody exported a parameter set, uploaded it, or read back what is aboard."""

    __tablename__ = "aboard_report"
    __table_args__ = (
        CheckConstraint("state IN ('exported', 'uploaded', 'confirmed', 'different')", name="state"),
        Index(None, "parameter_set_id", "id"),
        Index(None, "satellite_id", "magnetometer_id", "id"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    parameter_set_id: Mapped[str] = mapped_column(ForeignKey("parameter_set.id"))
    satellite_id: Mapped[str] = mapped_column(String(63))
    magnetometer_id: Mapped[str] = mapped_column(String(63))
    state: Mapped[str] = mapped_column(String(16))
    comparison: Mapped[dict[str, object] | None] = mapped_column(JsonColumn)
    matches_parameter_set_id: Mapped[str | None] = mapped_column(String(32))
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))
