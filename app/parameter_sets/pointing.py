"""HTTP of what a parameter set buys: attitude by magnetometer, simulated on demand."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final, cast

from fastapi import APIRouter, Query
from pydantic import Field
from sqlalchemy.orm import Session

from app.access.authentication import Reader
from app.access.caller import Caller
from app.http.concurrency import Places
from app.http.dependencies import Db
from app.http.schemas import Filter, Record
from app.http.strict_json import StrictJsonRoute
from app.orbits.nearest import chosen
from app.orbits.osculating_shape import OrbitShape, shape_of
from app.orbits.repository import OrbitRepository
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from app.records.parameter_set import parameter_set_record
from app.reporting.pointing import ImpactRecord, circle, pointing_of

if TYPE_CHECKING:
    from magcal_core.attitude.circular import CircularOrbit

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["parameter sets"])

PLACES: Final = Places("pointing simulations")


class PointingQuery(Filter):
    """The circular orbit on which the satellite points."""

    altitude_km: float | None = Field(
        None, ge=100, le=100_000, description="Of a circular orbit, km; unset: the satellite's own."
    )
    inclination_deg: float | None = Field(
        None, ge=0, le=180, description="Of the orbit, deg; unset: the satellite's own."
    )


class PointingRead(Record):
    """Largest errors of the last two of seven orbits."""

    max_error_deg: float
    max_rate_error_deg_s: float


class OrbitPointingRead(Record):
    """Pointing on one orbit; `active` is that of the set in force, null where it is this one or there is none."""

    altitude_km: float
    inclination_deg: float
    ideal: PointingRead
    raw: PointingRead
    calibrated: PointingRead
    active: PointingRead | None


class ImpactRead(Record):
    """What a parameter set buys; the real sensor is drawn from its covariance, and the worst draw counts."""

    parameter_set_id: str
    active_id: str | None
    orbits: list[OrbitPointingRead]
    field_model: str
    kp_nm: float
    kd_nms: float
    duration_s: float


@router.get("/{parameter_set_id}/pointing")
def get_pointing(parameter_set_id: str, query: Annotated[PointingQuery, Query()], caller: Reader, db: Db) -> ImpactRead:
    """Simulate how well attitude by magnetometer points raw, with this parameter set, and with the one in force."""
    with db.read() as session:
        sets = ParameterSetRepository(session, caller)
        row = sets.get(parameter_set_id)
        active = _active(sets, row)
        shape = _shape(session, caller, row)
    in_force = None if active is None else json.dumps(active.record)
    impact = json.loads(_impact(json.dumps(row.record), in_force, _orbits(query, shape)))
    ids = {"parameter_set_id": row.id, "active_id": None if active is None else active.id}
    return ImpactRead.model_validate(ids | impact)


def pointing_impact(parameter_set_id: str, caller: Caller, db: Db) -> ImpactRecord:
    """Return what a parameter set buys on its satellite's own orbit, as reports take it."""
    return cast("ImpactRecord", get_pointing(parameter_set_id, PointingQuery(), caller, db).model_dump())


@lru_cache(maxsize=64)
def _impact(record: str, active: str | None, orbits: tuple[CircularOrbit, ...]) -> str:
    """Return the pointing as JSON; the same question is answered from memory."""
    with PLACES.one():
        calibrated = parameter_set_record({"status": "candidate"} | json.loads(record))
        other = None if active is None else json.loads(active)["parameters"]
        return json.dumps(pointing_of(calibrated, other, orbits))


def _active(sets: ParameterSetRepository, row: ParameterSet) -> ParameterSet | None:
    found = sets.in_force(row.satellite_id, row.magnetometer_id)
    return None if found is None or found.id == row.id else found


def _shape(session: Session, caller: Caller, row: ParameterSet) -> OrbitShape | None:
    orbits = OrbitRepository(session, caller, row.satellite_id)
    near = chosen(orbits.around(row.data_from, row.data_until, 0.0), row.data_from)
    return None if near is None else shape_of(near.content)


def _orbits(query: PointingQuery, shape: OrbitShape | None) -> tuple[CircularOrbit, ...]:
    """Return the orbit that was asked for, else the satellite's own, else none: those of `pointing_of` then."""
    if shape is None and query.altitude_km is None and query.inclination_deg is None:
        return ()
    own = OrbitShape(500.0, 62.0) if shape is None else shape
    altitude_km = own.altitude_km if query.altitude_km is None else query.altitude_km
    inclination_deg = own.inclination_deg if query.inclination_deg is None else query.inclination_deg
    return (circle(altitude_km, inclination_deg),)
