"""HTTP of satellites and magnetometers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Query, Response

from app.access.authentication import Operator, Reader
from app.http.dependencies import Db
from app.http.paging import answered, page_of
from app.http.schemas import Page
from app.http.strict_json import StrictJsonRoute
from app.satellites.reading import unit_of
from app.satellites.repository import SatelliteRepository
from app.satellites.schemas import (
    MagnetometerChange,
    MagnetometerCreate,
    MagnetometerQuery,
    MagnetometerRead,
    MagnetometerShort,
    Policy,
    SatelliteChange,
    SatelliteCreate,
    SatelliteQuery,
    SatelliteRead,
    SatelliteShort,
)
from app.satellites.tables import Magnetometer, Satellite

router = APIRouter(route_class=StrictJsonRoute, prefix="/satellites", tags=["satellites"])


def _magnetometer(row: Magnetometer) -> MagnetometerRead:
    same = set(MagnetometerRead.model_fields) - {"satellite", "unit", "policy"}
    return MagnetometerRead(
        **{name: getattr(row, name) for name in same},
        satellite=row.satellite_id,
        unit=unit_of(row),
        policy=None if row.policy is None else Policy.model_validate(row.policy),
    )


def _satellite(row: Satellite, magnetometers: Sequence[Magnetometer]) -> SatelliteRead:
    return SatelliteRead(
        id=row.id,
        name=row.name,
        norad_id=row.norad_id,
        cospar_id=row.cospar_id,
        retention_days=row.retention_days,
        data_stale_days=row.data_stale_days,
        orbit_stale_days=row.orbit_stale_days,
        station_silent_hours=row.station_silent_hours,
        created_at=row.created_at,
        magnetometers=[_magnetometer(one) for one in magnetometers],
    )


@router.post("", status_code=201)
def create_satellite(body: SatelliteCreate, caller: Operator, db: Db, response: Response) -> SatelliteRead:
    """Register a satellite."""
    with db.write() as session:
        row = SatelliteRepository(session, caller).create(body)
    response.headers["Location"] = f"/api/v1/satellites/{row.id}"
    return _satellite(row, [])


@router.get("", response_model=Page[SatelliteRead] | Page[SatelliteShort])
def list_satellites(query: Annotated[SatelliteQuery, Query()], caller: Reader, db: Db) -> Response:
    """List the satellites, the newest first."""
    with db.read() as session:
        satellites = SatelliteRepository(session, caller)
        found = satellites.page(query)
        sensors = satellites.magnetometers([row.id for row in found.rows])
    items = [_satellite(row, sensors[row.id]) for row in found.rows]
    return answered(page_of(items, found, query, SatelliteShort))


@router.get("/{satellite_id}")
def get_satellite(satellite_id: str, caller: Reader, db: Db) -> SatelliteRead:
    """Show a satellite with its magnetometers."""
    with db.read() as session:
        satellites = SatelliteRepository(session, caller)
        row = satellites.get(satellite_id)
        return _satellite(row, satellites.magnetometers([row.id])[row.id])


@router.patch("/{satellite_id}")
def change_satellite(satellite_id: str, body: SatelliteChange, caller: Operator, db: Db) -> SatelliteRead:
    """Change a satellite's name, NORAD id, retention or limits of age."""
    with db.write() as session:
        satellites = SatelliteRepository(session, caller)
        row = satellites.change(satellite_id, body)
        return _satellite(row, satellites.magnetometers([row.id])[row.id])


@router.post("/{satellite_id}/magnetometers", status_code=201)
def create_magnetometer(satellite_id: str, body: MagnetometerCreate, caller: Operator, db: Db) -> MagnetometerRead:
    """Register a magnetometer of a satellite."""
    with db.write() as session:
        return _magnetometer(SatelliteRepository(session, caller).add_magnetometer(satellite_id, body))


@router.get("/{satellite_id}/magnetometers", response_model=Page[MagnetometerRead] | Page[MagnetometerShort])
def list_magnetometers(
    satellite_id: str, query: Annotated[MagnetometerQuery, Query()], caller: Reader, db: Db
) -> Response:
    """List the magnetometers of a satellite."""
    with db.read() as session:
        found = SatelliteRepository(session, caller).page_of_magnetometers(satellite_id, query)
    return answered(page_of([_magnetometer(row) for row in found.rows], found, query, MagnetometerShort))


@router.get("/{satellite_id}/magnetometers/{magnetometer_id}")
def get_magnetometer(satellite_id: str, magnetometer_id: str, caller: Reader, db: Db) -> MagnetometerRead:
    """Show one magnetometer of a satellite."""
    with db.read() as session:
        return _magnetometer(SatelliteRepository(session, caller).magnetometer(satellite_id, magnetometer_id))


@router.patch("/{satellite_id}/magnetometers/{magnetometer_id}")
def change_magnetometer(
    satellite_id: str, magnetometer_id: str, body: MagnetometerChange, caller: Operator, db: Db
) -> MagnetometerRead:
    """Change a magnetometer: how its telemetry is read from now on, its noise, the policy of its calibrations."""
    with db.write() as session:
        satellites = SatelliteRepository(session, caller)
        return _magnetometer(satellites.change_magnetometer(satellite_id, magnetometer_id, body))
