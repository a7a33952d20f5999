"""Tables of spacecraft and their magnetometers."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, ForeignKey, String
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class Satellite(Base):
    """One spacecraft."""

    __tablename__ = "satellite"

    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    name: Mapped[str | None] = mapped_column(String(200))
    norad_id: Mapped[str | None] = mapped_column(String(16))
    cospar_id: Mapped[str | None] = mapped_column(String(16))
    retention_days: Mapped[int | None]
    data_stale_days: Mapped[float | None]
    orbit_stale_days: Mapped[float | None]
    station_silent_hours: Mapped[float | None]
    created_at: Mapped[datetime]


class Magnetometer(Base):
    """One three-axis sensor of a satellite, and how its telemetry is read."""

    __tablename__ = "magnetometer"
    __table_args__ = (
        CheckConstraint("unit IN ('nT', 'uT', 'mT', 'T', 'G', 'mG')", name="unit"),
        CheckConstraint("noise_nt > 0", name="noise"),
        CheckConstraint("range_nt > 0", name="range"),
    )
    # Counts have no unit of their own here, as older versions know six: they are kept as nT with ``nt_per_count``.

    satellite_id: Mapped[str] = mapped_column(ForeignKey("satellite.id"), primary_key=True)
    id: Mapped[str] = mapped_column(String(63), primary_key=True)
    unit: Mapped[str] = mapped_column(String(2))
    noise_nt: Mapped[float | None]
    integration_s: Mapped[float | None]
    columns: Mapped[dict[str, str] | None] = mapped_column(JsonColumn)
    axis_map: Mapped[list[str] | None] = mapped_column(JsonColumn)
    range_nt: Mapped[float | None]
    nt_per_count: Mapped[float | None]
    time_format: Mapped[str | None] = mapped_column(String(100))
    time_epoch: Mapped[str | None] = mapped_column(String(40))
    fill_values: Mapped[list[float] | None] = mapped_column(JsonColumn)
    validity_column: Mapped[str | None] = mapped_column(String(200))
    valid_values: Mapped[list[str | float] | None] = mapped_column(JsonColumn)
    policy: Mapped[dict[str, object] | None] = mapped_column(JsonColumn)
    created_at: Mapped[datetime]
