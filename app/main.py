"""The application: its rooms, its middleware, and what it keeps from start to stop."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

import structlog
from fastapi import APIRouter, FastAPI
from fastapi_offline import FastAPIOffline
from starlette.concurrency import run_in_threadpool

from app.aboard import endpoints as aboard
from app.access import key_endpoints as keys
from app.access.authentication import FailureLimiter, RecentKeys, SteadyClock
from app.access.idempotency import Running
from app.access.oidc import open_issuer
from app.attention import endpoints as attention
from app.attention.entries import Fleet
from app.attention.watcher import Watcher
from app.connectors.orbits.watch import stopped_sources
from app.connectors.orbits.watcher import OrbitWatcher
from app.dashboard import endpoints as displays
from app.dashboard import pages
from app.field import endpoints as field
from app.http.allowed_methods import Methods
from app.http.entity_tags import Revalidation
from app.http.middleware.cors import allow_origins
from app.http.middleware.head_requests import HeadRequests
from app.http.middleware.request_limits import RequestLimits
from app.http.middleware.request_log import RequestLog
from app.http.middleware.security_headers import SecurityHeaders
from app.http.middleware.upload_gate import UploadGate
from app.http.openapi import complete
from app.http.problem_handlers import install_handlers
from app.http.receiving import Admission, sweep_incoming
from app.indices import endpoints as indices
from app.jobs import endpoints as jobs
from app.jobs import preview_endpoints
from app.jobs.engines.open_engine import Engine, open_engine
from app.maintenance import satellite_endpoints
from app.monitoring import endpoints as monitoring
from app.monitoring import rollouts, set_comparison, trends
from app.notes import endpoints as notes
from app.notifications import endpoints as notifications
from app.notifications.event_stream import NewestEntry
from app.notifications.notifier import Notifier
from app.operations import health
from app.orbits import endpoints as orbits
from app.parameter_sets import bias_paths, pointing, refits
from app.parameter_sets import endpoints as parameter_sets
from app.parameter_sets.json_listing import Texts
from app.satellites import endpoints as satellites
from app.sessions import endpoints as sessions
from app.settings import Settings
from app.storage.database import Database
from app.storage.identity import expect_own
from app.storage.open_store import open_store
from app.uploads import confirmation
from app.uploads import endpoints as uploads
from app.uploads.batching import Keeper
from app.uploads.ingest import Ingest

API: Final = "/api/v1"
ROOMS: Final = (
    sessions,
    uploads,
    confirmation,
    monitoring,
    satellites,
    satellite_endpoints,
    orbits,
    jobs,
    preview_endpoints,
    parameter_sets,
    pointing,
    refits,
    bias_paths,
    trends,
    rollouts,
    set_comparison,
    aboard,
    field,
    indices,
    keys,
    displays,
    attention,
    notes,
    notifications,
)
STOP_GRACE_S: Final = 20.0

log = structlog.get_logger()


def create_app(settings: Settings, *, workers: int) -> FastAPI:
    """Return the application over a database that is up to date, with ``workers`` job workers in this process."""
    app: FastAPI = FastAPIOffline(
        title="magcal",
        summary="In-flight magnetometer calibration.",
        version="1",
        redoc_url=None,
        lifespan=_lifespan,
        generate_unique_id_function=lambda route: route.name,
        telemetry={
            "tracing": False,
            "metrics": False,
            "logs": False,
        },  # nobody configures it; looking costs each request
    )
    database, store = Database(settings), open_store(settings)
    app.state.database_id = expect_own(database, store)
    app.state.settings = settings
    app.state.database = database
    app.state.store = store
    app.state.engine = open_engine(database, store, settings, workers)
    app.state.queue = app.state.engine.queue
    app.state.failures = FailureLimiter(settings.auth_failures_per_minute)
    app.state.recent = RecentKeys()
    app.state.clock = SteadyClock()
    app.state.issuer = open_issuer(settings)
    app.state.texts = Texts()
    app.state.uploads = Admission(settings.max_uploads_at_once, settings.max_uploads_per_key)
    app.state.running = Running()
    app.state.ingest = Ingest(database, store, app.state.queue, settings)
    app.state.keeper = Keeper(app.state.ingest, database)
    app.state.newest_entry = NewestEntry(database)
    app.state.is_stopping = lambda: False
    app.state.notifier = Notifier(database, settings)
    app.state.stopped_sources = lambda: stopped_sources(database)
    source = settings.orbit_source
    app.state.orbits = None if source is None else OrbitWatcher(database, settings, source)
    app.state.fleet = Fleet()
    app.state.unknown_page = pages.unknown_page
    app.state.watcher = Watcher(database, settings, app.state.queue)
    app.include_router(health.router)
    api = APIRouter(prefix=API)
    for room in ROOMS:
        api.include_router(room.router)
    app.include_router(api)
    app.include_router(pages.router)
    rooms = [room.router for room in ROOMS]
    complete(app, API, rooms)
    app.state.methods = Methods([("", health.router), ("", pages.router), *((API, room) for room in rooms)])
    install_handlers(app)
    app.add_middleware(HeadRequests)
    app.add_middleware(RequestLimits)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(Revalidation)
    app.add_middleware(RequestLog)
    allow_origins(app, settings)
    app.add_middleware(UploadGate, most=settings.max_uploads_at_once, most_per_key=settings.max_uploads_per_key)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    engine: Engine = app.state.engine
    left = sweep_incoming(app.state.settings)
    if left:
        log.info("incoming_swept", files=left)
    if engine.workers is not None:
        engine.workers.start()
    app.state.notifier.start()
    if app.state.orbits is not None:
        app.state.orbits.start()
    app.state.watcher.start()
    try:
        yield
    finally:
        await run_in_threadpool(app.state.watcher.stop)
        if engine.workers is not None:
            await run_in_threadpool(engine.workers.stop, STOP_GRACE_S)
        await run_in_threadpool(app.state.keeper.close)
        if app.state.orbits is not None:
            await run_in_threadpool(app.state.orbits.stop)
        await run_in_threadpool(app.state.notifier.stop)
        app.state.database.close()
