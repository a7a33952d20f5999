"""HTTP of telemetry."""

from __future__ import annotations

from typing import Annotated, Any, Final

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from app.auth import Reader, Station
from app.body import StrictJsonRoute
from app.idempotency import KeyHeader
from app.keys.repository import Caller
from app.resources import Blobs, Config, Db
from app.satellites.repository import SatelliteRepository
from app.schemas import Page, Slug, core_times
from app.sessions import judging
from app.sessions.ingest import Asked, Ingest
from app.sessions.repository import SessionRepository, samples_of
from app.sessions.schemas import ChunkRead, SampleQuery, SessionDetail, SessionQuery, SessionRead, UploadQuery
from app.sessions.tables import TelemetrySession
from app.sessions.upload import check_declared, is_short, receive
from app.tabular import table_response, wanted_format
from magcal_core.telemetry import MEDIA_TYPES, WRITERS, write_samples

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])

TELEMETRY_BODY: Final = {
    "requestBody": {
        "description": "The telemetry; gzip and zstd as Content-Encoding.",
        "required": True,
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in MEDIA_TYPES},
    }
}
COLUMNS: Final = {"type": "object", "additionalProperties": {"type": "array"}}
TABLES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "The table.",
        "content": {
            kind: {"schema": COLUMNS if form == "json" else {"type": "string"}}
            for kind, form in MEDIA_TYPES.items()
            if form in WRITERS
        },
    }
}


async def _ingest(request: Request) -> Ingest:
    ingest: Ingest = request.app.state.ingest
    return ingest


Ingests = Annotated[Ingest, Depends(_ingest)]


def _read(row: TelemetrySession, job_id: str | None = None) -> SessionRead:
    return SessionRead.model_validate(_values(row) | {"job_id": job_id})


def _values(row: TelemetrySession) -> dict[str, object]:
    same = set(SessionRead.model_fields) - {"satellite", "magnetometer", "job_id"}
    return {name: getattr(row, name) for name in same} | {
        "satellite": row.satellite_id,
        "magnetometer": row.magnetometer_id,
    }


def _check_day(request: Request, caller: Caller, db: Db, config: Config) -> None:
    if config.max_mb_per_day is None:
        return
    declared = check_declared(request, config)
    with db.read() as session:
        SessionRepository(session, caller).check_day(config.max_mb_per_day * 1_000_000, declared)


def _require_satellite(satellite_id: str, caller: Caller, db: Db) -> None:
    with db.read() as session:
        SatelliteRepository(session, caller).get(satellite_id)


@router.post(
    "/satellites/{satellite_id}/sessions",
    status_code=201,
    openapi_extra=TELEMETRY_BODY,
    responses={200: {"model": SessionRead, "description": "It was there already, with its bytes."}},
)
async def upload_session(
    satellite_id: str,
    query: Annotated[UploadQuery, Query()],
    request: Request,
    response: Response,
    caller: Station,
    key: KeyHeader = None,
) -> SessionRead:
    """Send telemetry of one magnetometer; the same bytes again are the same session, and mend it where it lost them."""
    state = request.app.state
    state.uploads.check(caller)
    if not is_short(request):
        await run_in_threadpool(_require_satellite, satellite_id, caller, state.database)
    if state.settings.max_mb_per_day is not None:
        await run_in_threadpool(_check_day, request, caller, state.database, state.settings)
    with state.running.hold(caller, key):
        async with state.uploads.place(caller):
            upload = await receive(request, state.settings)
            kept = await state.keeper.keep(Asked(caller, satellite_id, query, upload, key))
    response.status_code = 201 if kept.is_new or kept.is_restored else 200
    response.headers["Location"] = f"/api/v1/sessions/{kept.session.id}"
    if state.database_id is not None:
        response.headers["Magcal-Database"] = state.database_id
    return _read(kept.session, kept.job_id)


@router.post("/sessions/{session_id}/samples", openapi_extra=TELEMETRY_BODY)
async def append_samples(
    session_id: str, request: Request, caller: Station, config: Config, ingest: Ingests, db: Db
) -> SessionRead:
    """Append a chunk to an open session; the same bytes again change nothing."""
    await run_in_threadpool(_get_row, session_id, caller, db)
    await run_in_threadpool(_check_day, request, caller, db, config)
    async with request.app.state.uploads.place(caller):
        upload = await receive(request, config)
        return _read(await run_in_threadpool(ingest.append, caller, session_id, upload))


@router.post("/sessions/{session_id}/close")
def close_session(session_id: str, caller: Station, ingest: Ingests) -> SessionRead:
    """Close an open session; the magnetometer's policy may then calibrate it."""
    kept = ingest.close(caller, session_id)
    return _read(kept.session, kept.job_id)


def _get_row(session_id: str, caller: Caller, db: Db) -> TelemetrySession:
    with db.read() as session:
        return SessionRepository(session, caller).get(session_id)


@router.get("/sessions")
def list_sessions(query: Annotated[SessionQuery, Query()], caller: Reader, db: Db) -> Page[SessionRead]:
    """List the sessions, the newest first."""
    with db.read() as session:
        rows, cursor = SessionRepository(session, caller).page(query)
    return Page(items=[_read(row) for row in rows], next=cursor)


@router.get("/satellites/{satellite_id}/sessions")
def list_satellite_sessions(
    satellite_id: Slug, query: Annotated[SessionQuery, Query()], caller: Reader, db: Db
) -> Page[SessionRead]:
    """List the sessions of a satellite, the newest first."""
    _require_satellite(satellite_id, caller, db)
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
    return SessionDetail.model_validate(_values(row) | {"chunks": chunks})


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


router.routes.extend(judging.router.routes)
