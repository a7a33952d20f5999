"""HTTP of telemetry."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from app.access.authentication import Reader
from app.access.caller import Caller
from app.http.dependencies import Blobs, Db
from app.http.paging import answered, page_of
from app.http.schemas import Page, Slug, core_times
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TABLES, table_response, wanted_format
from app.satellites.repository import SatelliteRepository
from app.sessions.repository import SessionRepository, samples_of
from app.sessions.schemas import (
    AgreementRead,
    ChunkRead,
    SampleQuery,
    SessionDetail,
    SessionQuery,
    SessionRead,
    SessionShort,
)
from app.sessions.tables import SessionMonitoring, TelemetrySession
from magcal_core.telemetry import write_samples

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])


def session_read(
    row: TelemetrySession, job_id: str | None = None, judged: SessionMonitoring | None = None
) -> SessionRead:
    """Return a session as the service serves it."""
    return SessionRead.model_validate(_values(row, judged) | {"job_id": job_id})


def _values(row: TelemetrySession, judged: SessionMonitoring | None) -> dict[str, object]:
    same = set(SessionRead.model_fields) - {"satellite", "magnetometer", "job_id", "monitoring"}
    return {name: getattr(row, name) for name in same} | {
        "satellite": row.satellite_id,
        "magnetometer": row.magnetometer_id,
        "monitoring": None if judged is None else _agreement(judged),
    }


def _agreement(judged: SessionMonitoring) -> AgreementRead:
    own = {name: getattr(judged, name) for name in AgreementRead.model_fields if name != "reasons"}
    return AgreementRead.model_validate(own | {"reasons": judged.record.get("reasons", [])})


def require_satellite(satellite_id: str, caller: Caller, db: Db) -> None:
    """Raise `NotFoundError` where the caller reaches no such satellite."""
    with db.read() as session:
        SatelliteRepository(session, caller).get(satellite_id)


@router.get("/sessions", response_model=Page[SessionRead] | Page[SessionShort])
def list_sessions(query: Annotated[SessionQuery, Query()], caller: Reader, db: Db) -> Response:
    """List the sessions, the newest first."""
    with db.read() as session:
        sessions = SessionRepository(session, caller)
        found = sessions.page(query)
        judged = sessions.judgements([row.id for row in found.rows])
    items = [session_read(row, judged=judged.get(row.id)) for row in found.rows]
    return answered(page_of(items, found, query, SessionShort))


@router.get("/satellites/{satellite_id}/sessions", response_model=Page[SessionRead] | Page[SessionShort])
def list_satellite_sessions(
    satellite_id: Slug, query: Annotated[SessionQuery, Query()], caller: Reader, db: Db
) -> Response:
    """List the sessions of a satellite, the newest first."""
    require_satellite(satellite_id, caller, db)
    return list_sessions(query.model_copy(update={"satellite": satellite_id}), caller, db)


@router.get("/sessions/{session_id}")
def get_session(session_id: str, caller: Reader, db: Db) -> SessionDetail:
    """Show a session with the chunks that it came in."""
    with db.read() as session:
        sessions = SessionRepository(session, caller)
        row = sessions.get(session_id)
        chunks = [
            ChunkRead.model_validate({name: getattr(chunk, name) for name in ChunkRead.model_fields})
            for chunk in sessions.chunks(session_id)
        ]
        judged = sessions.judgements([row.id]).get(row.id)
    return SessionDetail.model_validate(_values(row, judged) | {"chunks": chunks})


@router.get("/sessions/{session_id}/samples", responses=TABLES)
def get_samples(
    session_id: str,
    query: Annotated[SampleQuery, Query()],
    request: Request,
    caller: Reader,
    db: Db,
    store: Blobs,
) -> Response:
    """Give the samples of a session, in nT and in time order, as CSV, NDJSON, JSON columns or Parquet."""
    form = wanted_format(request, query.format, "json")
    with db.read() as session:
        sessions = SessionRepository(session, caller)
        columns = sessions.columns(session_id, store)
    samples = samples_of(columns)
    for bound, keeps in ((query.since, np.greater_equal), (query.until, np.less_equal)):
        if bound is not None:
            samples = samples.take(keeps(samples.t_utc, core_times([bound])))
    return table_response(write_samples(samples, form, with_flags=query.flags), form, f"session-{session_id}")
