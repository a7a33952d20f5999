"""Bodies of the calls about what needs attention, and about the fleet."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, JsonValue, StringConstraints

from app.attention.causes.registry import CAUSES
from app.http.schemas import Body, Filter, Identifier, Page, PageQuery, Record, Search, Slug, UtcTime, View

SeverityName = Literal["act", "watch"]
Grade = Literal["accept", "weak", "refuse"]
Agreement = Literal["agrees", "watch", "disagrees", "too_short", "not_judged"]
State = Literal["act", "watch", "good"]
Code = Annotated[
    str, StringConstraints(pattern=f"^({'|'.join(CAUSES)})$"), Field(description=f"One of {', '.join(CAUSES)}.")
]
Text = Annotated[str, StringConstraints(min_length=1, max_length=2000, strip_whitespace=True)]


class LinksRead(Record):
    """What an entry is about."""

    session_id: str | None = None
    job_id: str | None = None
    parameter_set_id: str | None = None
    orbit_id: str | None = None


class ActionRead(Record):
    """What mends it: a call of the API with its body, or with GET a page to go to."""

    label: str
    method: Literal["GET", "POST"]
    path: str
    body: dict[str, JsonValue] | None = None


class AcknowledgementRead(Record):
    """Who has seen an entry."""

    by: str | None
    author: str | None = Field(description="Name of that key.")
    at: UtcTime
    until: UtcTime | None
    note: str | None


class AttentionShort(Record):
    """One magnetometer and cause in under 500 bytes."""

    id: str
    satellite_id: str
    magnetometer_id: str
    severity: SeverityName
    code: Code
    since: UtcTime


class AttentionRead(AttentionShort):
    """One magnetometer and cause."""

    text: str
    links: LinksRead
    action: ActionRead | None
    acknowledged: AcknowledgementRead | None


class AttentionCounts(Record):
    """Entries of each severity that nobody has acknowledged, and those that somebody has."""

    act: int
    watch: int
    acknowledged: int


class AttentionPage(Page[AttentionRead]):
    """A part of what needs attention, with the counts of all that the key may see."""

    counts: AttentionCounts


class AttentionShortPage(Page[AttentionShort]):
    """A part of what needs attention in short, with the counts of all that the key may see."""

    counts: AttentionCounts


class AttentionQuery(PageQuery):
    """Which entries."""

    q: Search | None = Field(None, description="Part of a code, or of an id or name of a satellite or magnetometer.")
    sort: Literal["worst", "since", "-since", "satellite", "-satellite"] = Field(
        "worst", description="`-since`: the newest first; those that are acknowledged stand behind the others."
    )

    severity: SeverityName | None = None
    code: Code | None = None
    satellite: Slug | None = None
    magnetometer: Slug | None = None
    acknowledged: bool | None = Field(None, description="Only those that are, or are not; unset: both, these behind.")
    session: Identifier | None = Field(None, description="Only what is about this session.")


class AcknowledgeBody(Body):
    """That somebody has seen it."""

    note: Text = Field(description="What is being done about it, or why nothing need be.")
    until: UtcTime | None = Field(None, description="Until when; unset: as long as the matter stays the same.")


class LastFailure(Record):
    """Why the newest calibration has failed."""

    job_id: str
    code: str | None
    detail: str | None
    at: UtcTime


class FleetShort(Record):
    """One magnetometer at a glance in under 500 bytes."""

    satellite: str
    name: str | None
    magnetometer: str
    state: State = Field(description="The worst that needs attention and that nobody has acknowledged.")
    attention: int = Field(description="Entries that nobody has acknowledged.")
    verdict: Grade | None = Field(description="Of the set in force.")
    data_until: UtcTime | None
    agreement: Agreement | None = Field(description="Of that session with the set in force.")
    residual_nt: float | None = Field(description="Residual of |B| of that session under the set in force, nT.")


class FleetRow(FleetShort):
    """One magnetometer at a glance."""

    parameter_set_id: str | None = Field(description="The set in force.")
    in_force_since: UtcTime | None
    session_id: str | None = Field(description="The session with the newest data.")
    received_at: UtcTime | None
    residual_ratio: float | None
    orbit_epoch: UtcTime | None
    last_failure: LastFailure | None
    is_calibrating: bool


class FacetsRead(Record):
    """How many magnetometers there are of each state and verdict, within the search."""

    state: dict[str, int]
    verdict: dict[str, int]
    agreement: dict[str, int]


class FleetPage(Page[FleetRow]):
    """A part of the fleet, how many fit, and how many there are of each kind."""

    facets: FacetsRead


class FleetShortPage(Page[FleetShort]):
    """A part of the fleet in short, how many fit, and how many there are of each kind."""

    facets: FacetsRead


class FleetQuery(Filter):
    """Which magnetometers, in which order."""

    q: str | None = Field(None, max_length=200, description="Part of an id or name of a satellite or magnetometer.")
    state: State | None = None
    verdict: Literal["accept", "weak", "refuse", "none"] | None = None
    agreement: Literal["agrees", "watch", "disagrees", "too_short", "not_judged", "none"] | None = None
    sort: Literal[
        "worst", "name", "-name", "data_until", "-data_until", "residual_nt", "-residual_nt", "verdict", "-verdict"
    ] = Field("worst", description="`-` turns the order round; what has no value comes last.")
    view: View = Field("full", description="`summary`: each item in under 500 bytes.")
    total: bool = Field(True, description="With how many there are in all parts together.")
    limit: int = Field(50, ge=1, le=1000, description="Most items in the answer.")
    cursor: str | None = Field(None, pattern=r"^\d{1,9}$", examples=["50"], description="`next` of the answer before.")
