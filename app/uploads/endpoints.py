"""HTTP of telemetry that arrives: whole sessions, samples for an open one, and its end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Operator, Station, authenticate
from app.access.caller import Caller
from app.access.idempotency import KeyHeader, Running
from app.http.dependencies import Config, Db
from app.http.receiving import check_declared, is_short, receive
from app.http.services import HttpServices, services_of
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TELEMETRY_BODY
from app.sessions.endpoints import require_satellite, session_read
from app.sessions.repository import SessionRepository
from app.sessions.schemas import ChunkQuery, SessionRead, UploadQuery
from app.sessions.tables import TelemetrySession
from app.uploads.batching import Keeper
from app.uploads.ingest import Asked, Ingest

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])


@dataclass(frozen=True, kw_only=True)
class UploadServices(HttpServices):
    """What uploads add to what the application holds; the id of the database is told to whoever sends."""

    database_id: str | None
    running: Running
    ingest: Ingest
    keeper: Keeper


async def _ingest(request: Request) -> Ingest:
    return services_of(request.app, UploadServices).ingest


Ingests = Annotated[Ingest, Depends(_ingest)]


def _check_day(request: Request, caller: Caller, db: Db, config: Config) -> None:
    if config.max_mb_per_day is None:
        return
    declared = check_declared(request, config)
    with db.read() as session:
        SessionRepository(session, caller).check_day(config.max_mb_per_day * 1_000_000, declared)


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
    held = services_of(request.app, UploadServices)
    held.admission.check(caller)
    if not is_short(request):
        await run_in_threadpool(require_satellite, satellite_id, caller, held.database)
    if held.settings.max_mb_per_day is not None:
        await run_in_threadpool(_check_day, request, caller, held.database, held.settings)
    with held.running.hold(caller, key):
        async with held.admission.place(caller):
            upload = await receive(request, held.settings, authenticate)
            kept = await held.keeper.keep(Asked(caller, satellite_id, query, upload, key))
    response.status_code = 201 if kept.is_new or kept.is_restored else 200
    response.headers["Location"] = f"/api/v1/sessions/{kept.session.id}"
    if held.database_id is not None:
        response.headers["Magcal-Database"] = held.database_id
    return session_read(kept.session, kept.job_id)


@router.post("/sessions/{session_id}/samples", openapi_extra=TELEMETRY_BODY)
async def append_samples(
    session_id: str,
    query: Annotated[ChunkQuery, Query()],
    request: Request,
    caller: Station,
    config: Config,
    ingest: Ingests,
    db: Db,
) -> SessionRead:
    """Append a chunk to an open session; the same bytes again change nothing."""
    await run_in_threadpool(_get_row, session_id, caller, db)
    await run_in_threadpool(_check_day, request, caller, db, config)
    async with services_of(request.app, UploadServices).admission.place(caller):
        upload = await receive(request, config, authenticate)
        return session_read(await run_in_threadpool(ingest.append, caller, session_id, upload, query.epoch_text))


@router.post("/sessions/{session_id}/close")
def close_session(session_id: str, caller: Station, ingest: Ingests) -> SessionRead:
    """Close an open session; the magnetometer's policy may then calibrate it."""
    kept = ingest.close(caller, session_id)
    return session_read(kept.session, kept.job_id)


def _get_row(session_id: str, caller: Caller, db: Db) -> TelemetrySession:
    with db.read() as session:
        return SessionRepository(session, caller).get(session_id)


@router.post("/sessions/{session_id}/read-again")
def read_again(session_id: str, caller: Operator, ingest: Ingests) -> SessionRead:
    """Read the bytes of a session again, as its magnetometer is read now."""
    return session_read(ingest.read_again(caller, session_id))
