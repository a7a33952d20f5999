"""HTTP of telemetry that arrives: whole sessions, samples for an open one, and its end."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Station
from app.access.caller import Caller
from app.access.idempotency import KeyHeader
from app.http.dependencies import Config, Db
from app.http.receiving import check_declared, is_short, receive
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TELEMETRY_BODY
from app.sessions.endpoints import require_satellite, session_read
from app.sessions.repository import SessionRepository
from app.sessions.schemas import SessionRead, UploadQuery
from app.sessions.tables import TelemetrySession
from app.uploads.ingest import Asked, Ingest

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])


async def _ingest(request: Request) -> Ingest:
    ingest: Ingest = request.app.state.ingest
    return ingest


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
    responses={200: {"model": SessionRead, "description": "It was there already."}},
)
async def upload_session(
    satellite_id: str,
    query: Annotated[UploadQuery, Query()],
    request: Request,
    response: Response,
    caller: Station,
    key: KeyHeader = None,
) -> SessionRead:
    """Send telemetry of one magnetometer; the same bytes again are the same session."""
    state = request.app.state
    state.uploads.check(caller)
    if not is_short(request):
        await run_in_threadpool(require_satellite, satellite_id, caller, state.database)
    if state.settings.max_mb_per_day is not None:
        await run_in_threadpool(_check_day, request, caller, state.database, state.settings)
    with state.running.hold(caller, key):
        async with state.uploads.place(caller):
            upload = await receive(request, state.settings)
            kept = await state.keeper.keep(Asked(caller, satellite_id, query, upload, key))
    response.status_code = 201 if kept.is_new else 200
    response.headers["Location"] = f"/api/v1/sessions/{kept.session.id}"
    return session_read(kept.session, kept.job_id)


@router.post("/sessions/{session_id}/samples", openapi_extra=TELEMETRY_BODY)
async def append_samples(
    session_id: str, request: Request, caller: Station, config: Config, ingest: Ingests, db: Db
) -> SessionRead:
    """Append a chunk to an open session; the same bytes again change nothing."""
    await run_in_threadpool(_get_row, session_id, caller, db)
    await run_in_threadpool(_check_day, request, caller, db, config)
    async with request.app.state.uploads.place(caller):
        upload = await receive(request, config)
        return session_read(await run_in_threadpool(ingest.append, caller, session_id, upload))


@router.post("/sessions/{session_id}/close")
def close_session(session_id: str, caller: Station, ingest: Ingests) -> SessionRead:
    """Close an open session; the magnetometer's policy may then calibrate it."""
    kept = ingest.close(caller, session_id)
    return session_read(kept.session, kept.job_id)


def _get_row(session_id: str, caller: Caller, db: Db) -> TelemetrySession:
    with db.read() as session:
        return SessionRepository(session, caller).get(session_id)
