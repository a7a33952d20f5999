"""Bodies of the orbits' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from app.http.schemas import Filter, PageQuery, Record, Search, UtcTime

OrbitFormat = Literal["tle", "omm", "oem", "state"]


class OrbitUpload(Filter):
    """How orbits are taken."""

    force: bool = Field(False, description="Keep orbits whose NORAD or COSPAR id is not the satellite's.")


class OrbitShort(Record):
    """One source of position in under 500 bytes."""

    id: str
    satellite: str
    format: OrbitFormat
    name: str | None
    epoch: UtcTime
    until: UtcTime | None = Field(description="End of an ephemeris; its epoch is its start.")
    sha256: str
    created_at: UtcTime
    created_by: str | None
    withdrawn_at: UtcTime | None = Field(description="Since when no calibration takes it any more.")
    age_days: float | None = Field(None, description="With `at`: distance of the time asked for from the epoch, days.")


class OrbitRead(OrbitShort):
    """One source of position."""

    details: dict[str, JsonValue]


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
    q: Search | None = Field(None, description="Part of an id, name, format or NORAD id.")
    sort: Literal["epoch", "-epoch", "created", "-created"] = Field(
        "-epoch", description="`-epoch`: the newest epoch first; `created` is when it was sent."
    )
