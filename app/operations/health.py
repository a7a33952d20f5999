"""HTTP outside the API: whether the service lives, whether it is ready, and its figures."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import structlog
from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import Field
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from app.access.authentication import authenticate
from app.access.caller import Scope
from app.attention.endpoints import Known
from app.errors import ServiceError
from app.http.dependencies import Blobs, Config, Db
from app.http.schemas import Record
from app.http.services import services_of
from app.jobs.dependencies import Jobs
from app.operations.magnetometer_metrics import MagnetometerState
from app.operations.queue_metrics import metrics_text

router = APIRouter(tags=["health"])
log = structlog.get_logger()

State = Literal["ok", "failing"]


@dataclass(frozen=True, kw_only=True)
class OperationServices:
    """What operations add to what the application holds.

    Attributes
    ----------
    preparing : how many of this process's kernels are compiled, and of how many; None once they all are.
    stopped_sources : the sources of orbits that are no longer asked, and why.
    """

    preparing: Callable[[], tuple[int, int] | None]
    stopped_sources: Callable[[], Sequence[str]]


class Alive(Record):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Ready(Record):
    """Whether each thing that the service needs is in reach."""

    status: State
    database: State
    store: State
    queue: State
    disk: State
    kernels: str = Field(
        description="`ok`, or `preparing` and how much is compiled: jobs wait for it, and everything else answers."
    )
    sources: str = Field(description="`ok`, or which sources of orbits are no longer asked, and why.")


@router.get("/healthz")
async def alive() -> Alive:
    """Say that the process answers."""
    return Alive()


@router.get("/readyz", responses={503: {"model": Ready, "description": "Something is out of reach."}})
def ready(  # noqa: PLR0917  FastAPI reads a call's inputs from its arguments
    request: Request, db: Db, store: Blobs, queue: Jobs, config: Config, response: Response
) -> Ready:
    """Say whether database, store, queue and disk are in reach."""
    found = {
        "database": _database(db),
        "store": _part(store),
        "queue": _part(queue),
        "disk": _state(shutil.disk_usage(config.data_dir).free >= config.min_free_mb << 20),
    }
    status = _state(all(state == "ok" for state in found.values()))
    response.status_code = 200 if status == "ok" else 503
    kernels = _kernels(services_of(request.app, OperationServices).preparing())
    return Ready(status=status, kernels=kernels, sources=_stopped(request, db), **found)


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
def metrics(request: Request, db: Db, config: Config, fleet: Known) -> Response:
    """Give the figures in Prometheus' text format; with a key that may read, also of each magnetometer it reaches."""
    caller = authenticate(request) if "authorization" in request.headers else None
    if caller is None or not caller.may(Scope.READ):
        return Response(metrics_text(db), media_type=CONTENT_TYPE_LATEST)
    own = MagnetometerState(db, fleet, caller, config.metrics_magnetometers)
    return Response(metrics_text(db, own), media_type=CONTENT_TYPE_LATEST)


def _state(is_good: bool) -> State:
    return "ok" if is_good else "failing"


def _kernels(preparing: tuple[int, int] | None) -> str:
    if preparing is None:
        return "ok"
    done, parts = preparing
    return f"preparing: {done} of {parts}" if parts else "preparing"


def _stopped(request: Request, db: Db) -> str:
    """Return which sources of orbits had to be stopped; that is no reason to take the service out of use."""
    if _database(db) != "ok":
        return "ok"
    return "; ".join(services_of(request.app, OperationServices).stopped_sources()) or "ok"


def _database(db: Db) -> State:
    try:
        db.check()
        db.look_for_damage()
        with db.read() as session:
            session.execute(text("SELECT 1"))
    except SQLAlchemyError as error:
        log.warning("not_ready", part="database", error=str(error))
        return "failing"
    return "ok"


def _part(part: Blobs | Jobs) -> State:
    try:
        part.check()
    except ServiceError as error:
        log.warning("not_ready", part=type(part).__name__, error=error.message)
        return "failing"
    return "ok"
