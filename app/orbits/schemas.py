"""Bodies of the orbits' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from app.schemas import PageQuery, Record, UtcTime

OrbitFormat = Literal["tle", "omm", "oem", "state"]


class OrbitRead(Record):
    """One source of position."""

    id: str
    satellite: str
    format: OrbitFormat
    name: str | None
    epoch: UtcTime
    valid_from: UtcTime | None
    valid_until: UtcTime | None
    details: dict[str, JsonValue]
    content: str = Field(description="The orbit as it was sent, alone.")
    created_at: UtcTime
    created_by: str | None
    age_days: float | None = Field(None, description="With `at`: the time asked for minus the epoch, days.")


class OrbitList(Record):
    """The orbits of a message, in its order."""

    items: list[OrbitRead]


class OrbitQuery(PageQuery):
    """Which orbits to list."""

    at: UtcTime | None = Field(None, description="Only the one that a calibration at this time would use.")
    format: OrbitFormat | None = None
