"""Satellites and magnetometers, as far as the caller's key reaches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from sqlalchemy import ColumnElement, select, true
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import ConflictError, NotFoundError
from app.http.paging import Part, Ways, fetch_page
from app.satellites.reading import changed
from app.satellites.schemas import (
    MagnetometerChange,
    MagnetometerCreate,
    MagnetometerQuery,
    SatelliteChange,
    SatelliteCreate,
    SatelliteQuery,
)
from app.satellites.tables import Magnetometer, Satellite
from app.storage.database import utc_now

SATELLITES: Final = Ways(
    {"created": (Satellite.created_at, Satellite.id), "id": (Satellite.id,)},
    searched=(Satellite.id, Satellite.name, Satellite.norad_id, Satellite.cospar_id),
)
MAGNETOMETERS: Final = Ways(
    {"id": (Magnetometer.id,), "created": (Magnetometer.created_at, Magnetometer.id)}, searched=(Magnetometer.id,)
)


def within_reach(column: InstrumentedAttribute[str], caller: Caller) -> ColumnElement[bool]:
    """Return the condition that keeps a query to the satellites that the caller's key is bound to."""
    return true() if caller.satellites is None else column.in_(sorted(caller.satellites))


class SatelliteRepository:
    """The satellites that a caller reaches."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller

    def create(self, wanted: SatelliteCreate) -> Satellite:
        """Return the new satellite ``wanted``."""
        if not self.caller.reaches(wanted.id):
            raise NotFoundError("no such satellite")
        if self.session.get(Satellite, wanted.id) is not None:
            raise ConflictError("there is a satellite of this id already")
        row = Satellite(**wanted.model_dump(), created_at=utc_now())
        self.session.add(row)
        record_event(self.session, self.caller, "satellite.create", row.id, row.id)
        return row

    def get(self, satellite_id: str) -> Satellite:
        """Return the satellite ``satellite_id``."""
        row = self.session.get(Satellite, satellite_id) if self.caller.reaches(satellite_id) else None
        if row is None:
            raise NotFoundError("no such satellite")
        return row

    def page(self, query: SatelliteQuery) -> Part[Satellite]:
        """Return a part of the satellites."""
        reached = select(Satellite).where(within_reach(Satellite.id, self.caller))
        return fetch_page(self.session, reached, SATELLITES, query)

    def page_of_magnetometers(self, satellite_id: str, query: MagnetometerQuery) -> Part[Magnetometer]:
        """Return a part of the magnetometers of a satellite."""
        own = select(Magnetometer).where(Magnetometer.satellite_id == self.get(satellite_id).id)
        return fetch_page(self.session, own, MAGNETOMETERS, query)

    def add_magnetometer(self, satellite_id: str, wanted: MagnetometerCreate) -> Magnetometer:
        """Return the new magnetometer ``wanted`` of a satellite."""
        satellite = self.get(satellite_id)
        if self.session.get(Magnetometer, (satellite.id, wanted.id)) is not None:
            raise ConflictError("the satellite has a magnetometer of this id already")
        policy = None if wanted.policy is None else wanted.policy.model_dump(mode="json", exclude_unset=True)
        row = Magnetometer(satellite_id=satellite.id, id=wanted.id, unit="nT", policy=policy, created_at=utc_now())
        changed(row, wanted.model_dump(exclude={"policy", "id"}))
        self.session.add(row)
        record_event(self.session, self.caller, "magnetometer.create", row.id, satellite.id)
        return row

    def change(self, satellite_id: str, wanted: SatelliteChange) -> Satellite:
        """Return the satellite with what ``wanted`` has changed."""
        row = self.get(satellite_id)
        for name, value in wanted.model_dump(exclude_unset=True).items():
            setattr(row, name, value)
        record_event(self.session, self.caller, "satellite.change", row.id, row.id)
        return row

    def change_magnetometer(self, satellite_id: str, magnetometer_id: str, wanted: MagnetometerChange) -> Magnetometer:
        """Return the magnetometer with what ``wanted`` has changed."""
        row = self.magnetometer(satellite_id, magnetometer_id)
        values = wanted.model_dump(exclude_unset=True, exclude={"policy"})
        if values:
            changed(row, values)
        if "policy" in wanted.model_fields_set:
            row.policy = None if wanted.policy is None else wanted.policy.model_dump(mode="json", exclude_unset=True)
        record_event(self.session, self.caller, "magnetometer.change", row.id, row.satellite_id)
        return row

    def magnetometer(self, satellite_id: str, magnetometer_id: str) -> Magnetometer:
        """Return one magnetometer of a satellite."""
        row = self.session.get(Magnetometer, (self.get(satellite_id).id, magnetometer_id))
        if row is None:
            raise NotFoundError("the satellite has no such magnetometer")
        return row

    def magnetometers(self, satellite_ids: Sequence[str]) -> dict[str, list[Magnetometer]]:
        """Return the magnetometers of each satellite."""
        found: dict[str, list[Magnetometer]] = {satellite_id: [] for satellite_id in satellite_ids}
        statement = select(Magnetometer).where(Magnetometer.satellite_id.in_(satellite_ids)).order_by(Magnetometer.id)
        for row in self.session.scalars(statement):
            found[row.satellite_id].append(row)
        return found
