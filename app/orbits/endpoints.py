"""HTTP of orbits."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Operator, OrbitSource, Reader, authenticate
from app.access.caller import Caller
from app.http.dependencies import Config, Db
from app.http.paging import Part, answered, page_of
from app.http.receiving import receive
from app.http.schemas import Page
from app.http.services import HttpServices, services_of
from app.http.strict_json import StrictJsonRoute
from app.orbits.nearest import chosen
from app.orbits.objects import check_objects
from app.orbits.parsing import ParsedOrbit, parse_message
from app.orbits.repository import OrbitRepository
from app.orbits.schemas import OrbitDetail, OrbitList, OrbitQuery, OrbitRead, OrbitShort, OrbitUpload
from app.orbits.tables import OrbitRow
from app.satellites.repository import SatelliteRepository
from app.storage.retry import retried

router = APIRouter(route_class=StrictJsonRoute, prefix="/satellites/{satellite_id}/orbits", tags=["orbits"])

ORBIT_BODY: Final = {
    "requestBody": {
        "description": "TLE or 3LE, OMM, OEM, or a state vector.",
        "required": True,
        "content": {
            kind: {"schema": {}}
            for kind in ("text/plain", "application/json", "application/xml", "application/octet-stream")
        },
    }
}


def _read(row: OrbitRow, at: datetime | None = None) -> OrbitRead:
    return OrbitRead.model_validate(_values(row, at))


def _values(row: OrbitRow, at: datetime | None = None) -> dict[str, object]:
    same = set(OrbitRead.model_fields) - {"satellite", "age_days"}
    is_covered = at is not None and row.until is not None and row.epoch <= at <= row.until
    age_days = None if at is None else 0.0 if is_covered else abs(at - row.epoch) / timedelta(days=1)
    return {name: getattr(row, name) for name in same} | {"satellite": row.satellite_id, "age_days": age_days}


@router.post(
    "",
    status_code=201,
    openapi_extra=ORBIT_BODY,
    responses={200: {"model": OrbitList, "description": "All of them were there already."}},
)
async def create_orbits(
    satellite_id: str,
    query: Annotated[OrbitUpload, Query()],
    request: Request,
    response: Response,
    caller: OrbitSource,
    db: Db,
    config: Config,
) -> OrbitList:
    """Send the orbits of a satellite; those that are there already are not kept twice."""
    await run_in_threadpool(_require, satellite_id, caller, db)
    async with services_of(request.app, HttpServices).admission.place(caller):
        upload = await receive(request, config, authenticate)
        parsed = await run_in_threadpool(parse_message, upload.content, upload.media_type)
        orbits, is_any_new = await run_in_threadpool(_keep, satellite_id, parsed, caller, db, is_forced=query.force)
    response.status_code = 201 if is_any_new else 200
    return orbits


def _require(satellite_id: str, caller: Caller, db: Db) -> None:
    with db.read() as session:
        OrbitRepository(session, caller, satellite_id)


def _keep(
    satellite_id: str, parsed: Sequence[ParsedOrbit], caller: Caller, db: Db, *, is_forced: bool
) -> tuple[OrbitList, bool]:
    def add() -> tuple[list[OrbitRow], bool]:
        with db.write() as session:
            if not is_forced:
                check_objects(SatelliteRepository(session, caller).get(satellite_id), parsed)
            return OrbitRepository(session, caller, satellite_id).add(parsed)

    rows, is_any_new = retried(add)
    return OrbitList(items=[_read(row) for row in rows]), is_any_new


@router.get("", response_model=Page[OrbitRead] | Page[OrbitShort])
def list_orbits(satellite_id: str, query: Annotated[OrbitQuery, Query()], caller: Reader, db: Db) -> Response:
    """List the orbits of a satellite, the newest epoch first; with `at`, the one that serves that time."""
    with db.read() as session:
        orbits = OrbitRepository(session, caller, satellite_id)
        found = orbits.page(query) if query.at is None else _serving(orbits, query.at, query)
        items = [_read(row, query.at) for row in found.rows]
    return answered(page_of(items, found, query, OrbitShort))


def _serving(orbits: OrbitRepository, at: datetime, query: OrbitQuery) -> Part[OrbitRow]:
    """Return the one orbit that serves a time, if any does."""
    row = chosen(orbits.around(at, at, 0.0), at)
    rows = [] if row is None else [row]
    return Part(rows, None, len(rows) if query.total else None)


@router.post("/{orbit_id}/withdraw")
def withdraw_orbit(satellite_id: str, orbit_id: str, caller: Operator, db: Db) -> OrbitRead:
    """Take an orbit out of use, such as one of another object; it stays for what was made with it."""
    with db.write() as session:
        return _read(OrbitRepository(session, caller, satellite_id).withdraw(orbit_id))


@router.post("/{orbit_id}/restore")
def restore_orbit(satellite_id: str, orbit_id: str, caller: Operator, db: Db) -> OrbitRead:
    """Put an orbit that was withdrawn to use again."""
    with db.write() as session:
        return _read(OrbitRepository(session, caller, satellite_id).restore(orbit_id))


@router.get("/{orbit_id}")
def get_orbit(satellite_id: str, orbit_id: str, caller: Reader, db: Db) -> OrbitDetail:
    """Show an orbit with its text."""
    with db.read() as session:
        row = OrbitRepository(session, caller, satellite_id).get(orbit_id)
    return OrbitDetail.model_validate(_values(row) | {"content": row.content})
