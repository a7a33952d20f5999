"""HTTP of trends: a magnetometer's parameters across its sets, between them, now, and how long a set lives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from pydantic import Field, JsonValue
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.authentication import Reader
from app.access.caller import Caller
from app.http.concurrency import Places
from app.http.dependencies import Db
from app.http.schemas import Filter, Record, UtcTime, utc_text
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TABLES, TableFormat, table_response, wanted_format, write_table
from app.monitoring.trend_table import MOST_POINTS, POINTS, series_of, trend_table
from app.parameter_sets.schemas import ParametersRead
from app.parameter_sets.tables import ParameterSet
from app.records.json_numbers import without_nan
from app.satellites.repository import SatelliteRepository
from magcal_core.telemetry.iso_times import parse_iso_time

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.trend import Trend

router = APIRouter(route_class=StrictJsonRoute, prefix="/satellites", tags=["monitoring"])

MOST_SETS: Final = 2000
"""Newest parameter sets that a trend is made of."""
SHARE: Final = 0.01
FIELD_NT: Final = 40_000.0
PLACES: Final = Places("trends")
AT_HAND: Final = 8
"""Trends that a process keeps: table, figure and life of a page are of one."""
_NEEDED: Final = ("verdict", "data_from", "data_until", "method", "parameters", "parameter_names", "covariance")


class SpanQuery(Filter):
    """Which parameter sets a trend is made of."""

    since: str | None = Field(None, max_length=64, description="Sets of data that reach to this time or beyond.")
    until: str | None = Field(None, max_length=64, description="Sets of data that begin at this time or before.")


class TrendQuery(SpanQuery):
    """What a trend is told for."""

    at: str | None = Field(
        None, max_length=64, description="Time that it is told for, ISO 8601 with Z; the end of the last set's data."
    )
    share: float = Field(SHARE, description="Share of the field that the error of a set may reach in its life.")
    field_nt: float = Field(FIELD_NT, description="Field that the errors are told for, nT.")


class SeriesQuery(Filter):
    """Which times of a trend."""

    from_: str | None = Field(None, alias="from", max_length=64, description="First time; that of the first set.")
    until: str | None = Field(None, max_length=64, description="Last time; the end of the last set's data.")
    points: int = Field(POINTS, ge=1, le=MOST_POINTS, description="Times, evenly spaced.")
    format: TableFormat | None = Field(None, description="Instead of Accept.")


class TrendJumpRead(Record):
    """A change of one group of parameters between two sets; when in between, nobody knows."""

    group: str
    from_set: str
    until_set: str
    from_: UtcTime = Field(alias="from", description="Time of the set before it.")
    until: UtcTime = Field(description="Time of the set after it.")
    change: list[float]
    standard_errors: list[float]
    p_value: float
    text: str


class LeftOutRead(Record):
    """A set that does not count."""

    parameter_set_id: str
    reason: Literal["refused", "other_kind", "same_data", "outlier"]


class LifeRead(Record):
    """How long a set stays good."""

    parameter_set_id: str | None
    share: float = Field(description="Share of the field that the bound of its error may reach.")
    days: float | None = Field(description="From `at`; null where that cannot be told, `text` says why.")
    is_capped: bool = Field(description="At least `days`: beyond twice the span of the history nothing is said.")
    until: UtcTime | None
    text: str


class WithoutRead(Record):
    """The trend without its last set."""

    parameters: ParametersRead
    standard_errors: ParametersRead


class UnconfirmedRead(Record):
    """A last set far from what the others forecast: a jump, or a bad set."""

    parameter_set_id: str
    p_value: float
    without: WithoutRead


class TrendRead(Record):
    """The trend of a magnetometer's parameters."""

    satellite: str
    magnetometer: str
    at: UtcTime
    status: Literal["ok", "erratic"]
    sets: int = Field(description="That count.")
    since: UtcTime
    until: UtcTime
    parameters: ParametersRead
    standard_errors: ParametersRead
    parameter_names: list[str]
    covariance: list[list[float]]
    field_error_nt: float = Field(description="Bound that the corrected field's error keeps in 95 of 100 cases, nT.")
    walk: dict[str, float] = Field(description="Random walk of each group, share per root year.")
    scatter: dict[str, float] = Field(description="Scatter from session to session of each group, share.")
    jumps: list[TrendJumpRead]
    left_out: list[LeftOutRead]
    warnings: list[str]
    unconfirmed: UnconfirmedRead | None
    life: LifeRead


@router.get("/{satellite_id}/magnetometers/{magnetometer_id}/trend", response_model_by_alias=True)
def get_trend(
    satellite_id: str, magnetometer_id: str, query: Annotated[TrendQuery, Query()], caller: Reader, db: Db
) -> TrendRead:
    """Give a magnetometer's parameters at a time as all its sets tell them, and how long its active set stays good."""
    sets = sets_of(satellite_id, magnetometer_id, caller, db, since=query.since, until=query.until)
    found = trend_of(sets, query.at, query.share, query.field_nt)
    return TrendRead.model_validate(without_nan(found.to_dict()))


@router.get("/{satellite_id}/magnetometers/{magnetometer_id}/trend/series", responses=TABLES)
def get_trend_series(
    *,
    satellite_id: str,
    magnetometer_id: str,
    query: Annotated[SeriesQuery, Query()],
    request: Request,
    caller: Reader,
    db: Db,
) -> Response:
    """Give the trend over time as CSV, NDJSON, JSON columns or Parquet: values, errors, bound of the field's error."""
    form = wanted_format(request, query.format, "json")
    found = trend_of(sets_of(satellite_id, magnetometer_id, caller, db))
    begin, end = (None if text is None else _time(text) for text in (query.from_, query.until))
    with PLACES.one():
        states = series_of(found, begin, end, query.points)
    return table_response(write_table(trend_table(states), form), form, f"trend-{satellite_id}-{magnetometer_id}")


@dataclass(frozen=True, slots=True)
class StoredSets:
    """Parameter sets of one magnetometer: which they are, by id and status, and their records."""

    key: tuple[tuple[str, str], ...]
    records: tuple[Mapping[str, object], ...] = field(compare=False, repr=False)


def sets_of(
    satellite_id: str,
    magnetometer_id: str,
    caller: Caller,
    db: Db,
    *,
    since: str | None = None,
    until: str | None = None,
) -> StoredSets:
    """Return the newest sets of a magnetometer that the caller reaches, of a span of time where one is given."""
    bounds = [None if text is None else _time(text) for text in (since, until)]
    with db.read() as session:
        SatelliteRepository(session, caller).magnetometer(satellite_id, magnetometer_id)
        return stored_sets(session, satellite_id, magnetometer_id, *bounds)


def stored_sets(
    session: Session,
    satellite_id: str,
    magnetometer_id: str,
    since: np.datetime64 | None = None,
    until: np.datetime64 | None = None,
) -> StoredSets:
    """Return the newest sets of a magnetometer, of a span of time where one is given."""
    row_of = ParameterSet
    statement = select(row_of).where(row_of.satellite_id == satellite_id, row_of.magnetometer_id == magnetometer_id)
    if since is not None:
        statement = statement.where(row_of.data_until >= _aware(since))
    if until is not None:
        statement = statement.where(row_of.data_from <= _aware(until))
    rows = session.scalars(statement.order_by(row_of.id.desc()).limit(MOST_SETS)).all()
    return StoredSets(tuple((row.id, row.status) for row in rows), tuple(_record(row) for row in rows))


def trend_of(sets: StoredSets, at: str | None = None, share: float = SHARE, field_nt: float = FIELD_NT) -> Trend:
    """Return the trend of stored sets; nothing is stored."""
    with PLACES.one():
        return _made(sets, None if at is None else int(_time(at).astype(np.int64)), share, field_nt)


@lru_cache(maxsize=AT_HAND)
def _made(sets: StoredSets, at_ns: int | None, share: float, field_nt: float) -> Trend:
    from magcal_core.calibration.sessions.trend import trend

    return trend(sets.records, None if at_ns is None else np.datetime64(at_ns, "ns"), share, field_nt)


def _record(row: ParameterSet) -> Mapping[str, JsonValue | object]:
    """Return what a trend needs of a stored set."""
    return {name: row.record[name] for name in _NEEDED if name in row.record} | {
        "id": row.id,
        "satellite": row.satellite_id,
        "magnetometer": row.magnetometer_id,
        "status": row.status,
        "created_at": utc_text(row.created_at),
    }


def _time(text: str) -> np.datetime64:
    """Return a time of a query, UTC.

    Raises
    ------
    TimeError
        The text is no time with a zone.
    """
    return parse_iso_time(text)


def _aware(t_utc: np.datetime64) -> object:
    """Return a time as the database's columns compare it: zone-aware UTC."""
    from datetime import UTC

    return t_utc.astype("datetime64[us]").item().replace(tzinfo=UTC)
