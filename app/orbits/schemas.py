"""Bodies of the orbits' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from app.http.schemas import PageQuery, Record, UtcTime

OrbitFormat = Literal["tle", "omm", "oem", "state"]


class OrbitRead(Record):
    """One source of position."""

    id: str
    satellite: str
    format: OrbitFormat
    name: str | None
    epoch: UtcTime
    until: UtcTime | None = Field(description="End of an ephemeris; its epoch is its start.")
    sha256: str
    details: dict[str, JsonValue]
    created_at: UtcTime
    created_by: str | None
    age_days: float | None = Field(None, description="With `at`: distance of the time asked for from the epoch, days.")


class OrbitDetail(OrbitRead):
    """One source of position with its text."""

    content: str


class OrbitList(Record):
    """The orbits of a message, in its order."""

    items: list[OrbitRead]


class OrbitQuery(PageQuery):
    """Which orbits to list."""

    at: UtcTime | None = Field(None, description="Only the one that a calibration at this time would use.")
    format: OrbitFormat | None = None
