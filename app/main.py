"""The application: its rooms, its middleware, and what it keeps from start to stop."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
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
from app.dashboard.pages import PageServices
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
from app.http.services import Stopping, install, services_of
from app.indices import endpoints as indices
from app.jobs import endpoints as jobs
from app.jobs import preview_endpoints
from app.jobs.dependencies import JobServices
from app.jobs.engines.open_engine import open_engine
from app.jobs.queue import Workers
from app.maintenance import satellite_endpoints
from app.monitoring import endpoints as monitoring
from app.monitoring import rollouts, set_comparison, trends
from app.notes import endpoints as notes
from app.notifications import endpoints as notifications
from app.notifications.event_stream import EventServices, NewestEntry
from app.notifications.notifier import Notifier
from app.operations import health
from app.operations.health import OperationServices
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
from app.uploads import preview as upload_preview
from app.uploads.batching import Keeper
from app.uploads.endpoints import UploadServices
from app.uploads.ingest import Ingest

API: Final = "/api/v1"
ROOMS: Final = (
    sessions,
    uploads,
    confirmation,
    upload_preview,
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


@dataclass(frozen=True, kw_only=True)
class Services(UploadServices, PageServices, JobServices, EventServices, OperationServices):
    """What the application holds from start to stop: what its rooms need of it, and what works beside requests."""

    workers: Workers | None
    notifier: Notifier
    orbit_watcher: OrbitWatcher | None
    attention_watcher: Watcher


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
    services = _services(settings, workers)
    install(app, services)
    app.include_router(health.router)
    api = APIRouter(prefix=API)
    for room in ROOMS:
        api.include_router(room.router)
    app.include_router(api)
    app.include_router(pages.router)
    complete(app, API, [room.router for room in ROOMS])
    install_handlers(app)
    app.add_middleware(HeadRequests)
    app.add_middleware(RequestLimits)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(Revalidation)
    app.add_middleware(RequestLog)
    allow_origins(app, settings)
    app.add_middleware(UploadGate, most=settings.max_uploads_at_once, most_per_key=settings.max_uploads_per_key)
    return app


def _services(settings: Settings, workers: int) -> Services:
    """Return what the application holds, nothing of it started yet."""
    database, store = Database(settings), open_store(settings)
    database_id = expect_own(database, store)
    engine = open_engine(database, store, settings, workers)
    ingest = Ingest(database, store, engine.queue, settings)
    source = settings.orbit_source
    fleet = Fleet()
    return Services(
        settings=settings,
        database=database,
        database_id=database_id,
        store=store,
        admission=Admission(settings.max_uploads_at_once, settings.max_uploads_per_key),
        methods=Methods([("", health.router), ("", pages.router), *((API, room.router) for room in ROOMS)]),
        stopping=Stopping(),
        unknown_page=pages.unknown_page,
        failures=FailureLimiter(settings.auth_failures_per_minute),
        recent_keys=RecentKeys(),
        clock=SteadyClock(),
        issuer=open_issuer(settings),
        texts=Texts(),
        fleet=fleet,
        queue=engine.queue,
        workers=engine.workers,
        running=Running(),
        ingest=ingest,
        keeper=Keeper(ingest, database),
        newest_entry=NewestEntry(database),
        preparing=lambda: None if engine.workers is None else engine.workers.kernels.preparing,
        stopped_sources=lambda: stopped_sources(database),
        notifier=Notifier(database, settings),
        orbit_watcher=None if source is None else OrbitWatcher(database, settings, source),
        attention_watcher=Watcher(database, settings, engine.queue, fleet),
    )


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    services = services_of(app, Services)
    left = sweep_incoming(services.settings)
    if left:
        log.info("incoming_swept", files=left)
    if services.workers is not None:
        services.workers.start()
    services.notifier.start()
    if services.orbit_watcher is not None:
        services.orbit_watcher.start()
    services.attention_watcher.start()
    try:
        yield
    finally:
        await run_in_threadpool(services.attention_watcher.stop)
        if services.workers is not None:
            await run_in_threadpool(services.workers.stop, STOP_GRACE_S)
        await run_in_threadpool(services.keeper.close)
        if services.orbit_watcher is not None:
            await run_in_threadpool(services.orbit_watcher.stop)
        await run_in_threadpool(services.notifier.stop)
        services.database.close()
