"""HTTP of what a session says of parameter sets that need not come from it: against the active one, beside a second."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from fastapi import APIRouter, Query, Request
from pydantic import Field
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Reader, authenticate
from app.access.caller import SYSTEM, Caller
from app.errors import NotFoundError
from app.http.dependencies import Blobs, Config, Db
from app.http.receiving import Upload, receive
from app.http.schemas import Filter, Identifier, Record
from app.http.services import HttpServices, services_of
from app.http.strict_json import StrictJsonRoute
from app.indices.repository import sources_of_record
from app.orbits.parsing import orbit_of
from app.orbits.repository import OrbitRepository
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from app.sessions.repository import SessionRepository, samples_of
from app.sessions.tables import TelemetrySession
from app.storage.database import Database
from app.storage.store import Store
from magcal_core.errors import OptionError
from magcal_core.orbit import Orbit
from magcal_core.orbit.sources import parse_sources
from magcal_core.samples import Samples
from magcal_core.which_object import WhichObject, which_object

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])

ORBITS_BODY: Final = {
    "requestBody": {
        "description": "Orbits of all objects of a launch, in any form that orbits are read in.",
        "required": True,
        "content": {kind: {"schema": {}} for kind in ("text/plain", "application/json", "application/xml", "text/csv")},
    }
}

ORBIT_AGE_DAYS = 14.0


class MonitoringQuery(Filter):
    """Against which parameter set."""

    parameter_set: Identifier | None = Field(None, description="The one in force unless given.")


class DriftRead(Record):
    """How far a parameter of the session lies from that of the parameter set: session - parameter set."""

    parameter: str
    first: str
    second: str
    difference: float | None
    standard_error: float | None
    p_value: float | None
    sigmas: float | None


class MonitoringRead(Record):
    """What a session says of a parameter set, without a refit."""

    session_id: str
    parameter_set_id: str
    grade: Literal["agrees", "watch", "disagrees", "too_short"]
    reasons: list[str]
    samples: int
    residual_rms_nt: float | None
    residual_mean_nt: float | None
    residual_ratio: float | None = Field(description="Over the residual of the parameter set on its own data.")
    p_value: float | None = Field(description="Probability of drifts so large where there are none.")
    field_change_nt: float | None = Field(description="By how much the drifts would change the corrected field, nT.")
    field_change_error_nt: float | None
    drifts: list[DriftRead]


class ComparisonQuery(Filter):
    """With which session of the other magnetometer, and under which parameter sets."""

    other: Identifier = Field(description="Session of a second magnetometer of the same satellite.")
    parameter_set: Identifier | None = Field(None, description="Of this session's; the one in force unless given.")
    other_parameter_set: Identifier | None = Field(None, description="Of the other's; the one in force unless given.")
    distance_m: float | None = Field(None, gt=0.0, description="Between the two places, m: gives the gradient.")


class AngleRead(Record):
    """Angle between the directions of two corrected readings."""

    mean_deg: float
    rms_deg: float
    max_deg: float


class ComparisonRead(Record):
    """How two magnetometers differ once each is corrected: first = (1 + gain) rotation second + offset."""

    session_id: str
    parameter_set_id: str
    other_session_id: str
    other_parameter_set_id: str
    pairs: int
    rotation: list[list[float]]
    rotation_vector_deg: list[float]
    rotation_errors_deg: list[float]
    offset_nt: list[float]
    offset_errors_nt: list[float]
    gradient_nt_per_m: list[float] | None
    gain: list[list[float]]
    gain_errors: list[list[float]]
    direction_before: AngleRead
    direction_after: AngleRead
    rms_before_nt: float
    rms_after_nt: float
    findings: list[str]


@router.get("/sessions/{session_id}/monitoring")
def get_session_monitoring(
    session_id: str, query: Annotated[MonitoringQuery, Query()], caller: Reader, db: Db, store: Blobs
) -> MonitoringRead:
    """Judge a session against the parameter set in force, or a given one; nothing is refitted."""
    from app.records.json_numbers import without_nan
    from magcal_core.sessions import monitor

    with db.read() as session:
        row = SessionRepository(session, caller).get(session_id)
        chosen = _parameter_set(session, caller, row, query.parameter_set)
        near = _orbits(session, row)
        samples = _samples(session, caller, row, store)
        sources = sources_of_record(session, chosen.record, samples.t_utc)
    judged = monitor(samples, near, chosen.record, max_orbit_age_days=ORBIT_AGE_DAYS, sources=sources).to_dict()
    ids = {"session_id": row.id, "parameter_set_id": chosen.id}
    return MonitoringRead.model_validate(without_nan(judged | ids))


@router.get("/sessions/{session_id}/comparison")
def get_session_comparison(
    session_id: str, query: Annotated[ComparisonQuery, Query()], caller: Reader, db: Db, store: Blobs
) -> ComparisonRead:
    """Compare two magnetometers of one satellite, each corrected with its own parameter set."""
    from magcal_core.calibration.sessions.monitoring import ActiveSet
    from magcal_core.sessions import compare_sensors

    with db.read() as session:
        sessions = SessionRepository(session, caller)
        rows = (sessions.get(session_id), sessions.get(query.other))
        if rows[0].satellite_id != rows[1].satellite_id or rows[0].magnetometer_id == rows[1].magnetometer_id:
            raise OptionError("the sessions are not of two magnetometers of one satellite")
        wanted = (query.parameter_set, query.other_parameter_set)
        chosen = [_parameter_set(session, caller, row, one) for row, one in zip(rows, wanted, strict=True)]
        samples = [_samples(session, caller, row, store) for row in rows]
    first, second = (ActiveSet.from_record(one.record).parameters for one in chosen)
    found = compare_sensors((samples[0], first), (samples[1], second), distance_m=query.distance_m).to_dict()
    ids = {"session_id": rows[0].id, "parameter_set_id": chosen[0].id}
    others = {"other_session_id": rows[1].id, "other_parameter_set_id": chosen[1].id}
    return ComparisonRead.model_validate(found | ids | others)


def _parameter_set(session: Session, caller: Caller, row: TelemetrySession, wanted: str | None) -> ParameterSet:
    """Return the parameter set ``wanted``, which must be of the session's magnetometer, or the one in force."""
    sets = ParameterSetRepository(session, caller)
    if wanted is None:
        found = sets.in_force(row.satellite_id, row.magnetometer_id)
        if found is None:
            raise NotFoundError("no parameter set is in force for the magnetometer; name one")
        return found
    chosen = sets.get(wanted)
    if (chosen.satellite_id, chosen.magnetometer_id) != (row.satellite_id, row.magnetometer_id):
        raise OptionError("the parameter set is not of the session's magnetometer")
    return chosen


def _orbits(session: Session, row: TelemetrySession) -> list[Orbit]:
    if row.data_from is None or row.data_until is None:
        return []
    near = OrbitRepository(session, SYSTEM, row.satellite_id).around(row.data_from, row.data_until, ORBIT_AGE_DAYS)
    return [orbit_of(one.content) for one in near]


def _samples(session: Session, caller: Caller, row: TelemetrySession, store: Store) -> Samples:
    return samples_of(SessionRepository(session, caller).columns(row.id, store))


class ObjectQuery(Filter):
    """Which orbits count."""

    max_orbit_age_days: float = Field(
        ORBIT_AGE_DAYS, gt=0, le=1000, description="Refuse orbits further from the session, days."
    )


class ObjectRead(Record):
    """One object, and how well its orbits explain the session."""

    norad_id: str
    cospar_id: str
    name: str
    epoch: str
    age_days: float
    residual_nt: float | None = Field(description="1.4826 times the median size of the residual, nT.")
    behind_first: float | None = Field(description="Standard errors by which its residuals exceed those of the first.")
    reason: str | None


class WhichObjectRead(Record):
    """Which of the objects the session is of; the smallest residual first."""

    state: Literal["told", "ambiguous", "none"]
    text: str
    objects: list[ObjectRead]


@router.post("/sessions/{session_id}/which-object", openapi_extra=ORBITS_BODY)
async def tell_object(
    session_id: Identifier,
    query: Annotated[ObjectQuery, Query()],
    request: Request,
    *,
    caller: Reader,
    db: Db,
    store: Blobs,
    config: Config,
) -> WhichObjectRead:
    """Tell of which object a session is, by the residuals that the orbits of each leave; nothing is kept."""
    columns = await run_in_threadpool(_columns, session_id, caller, db, store)
    async with services_of(request.app, HttpServices).admission.place(caller):
        upload = await receive(request, config, authenticate)
        found = await run_in_threadpool(_told, columns, upload, query.max_orbit_age_days)
    return WhichObjectRead.model_validate(found.to_dict())


def _columns(session_id: str, caller: Caller, db: Database, store: Store) -> list[bytes]:
    with db.read() as session:
        return SessionRepository(session, caller).columns(session_id, store)


def _told(columns: list[bytes], upload: Upload, max_age_days: float) -> WhichObject:
    sources = parse_sources(upload.content, upload.media_type)
    return which_object(samples_of(columns), sources, max_orbit_age_days=max_age_days)
