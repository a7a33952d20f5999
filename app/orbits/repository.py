"""Orbits, as far as the caller's key reaches; equal ones are kept once."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.database import new_id, utc_now
from app.errors import NotFoundError
from app.keys.repository import Caller, record_event
from app.orbits.parsing import ParsedOrbit
from app.orbits.schemas import OrbitQuery
from app.orbits.tables import OrbitRow
from app.paging import fetch_page
from app.satellites.repository import SatelliteRepository
from app.store import digest

MOST_CANDIDATES: Final = 400


class OrbitRepository:
    """The orbits of one satellite that a caller reaches."""

    def __init__(self, session: Session, caller: Caller, satellite_id: str) -> None:
        self.session = session
        self.caller = caller
        self.satellite_id = SatelliteRepository(session, caller).get(satellite_id).id

    def add(self, orbits: Sequence[ParsedOrbit]) -> tuple[list[OrbitRow], bool]:
        """Return the rows of ``orbits`` in their order, and whether any of them is new."""
        rows, is_any_new = [], False
        for orbit in orbits:
            row, is_new = self._add(orbit)
            rows.append(row)
            is_any_new |= is_new
        if is_any_new:
            record_event(self.session, self.caller, "orbit.create", rows[0].id, self.satellite_id)
        return rows, is_any_new

    def _add(self, orbit: ParsedOrbit) -> tuple[OrbitRow, bool]:
        values = {
            "id": new_id(),
            "satellite_id": self.satellite_id,
            "format": orbit.format,
            "name": orbit.name,
            "epoch": orbit.epoch,
            "until": orbit.until,
            "content": orbit.content,
            "sha256": digest(orbit.content.encode()),
            "details": orbit.details,
            "created_at": utc_now(),
            "created_by": self.caller.key_id,
        }
        insert = postgresql.insert if self.session.get_bind().dialect.name == "postgresql" else sqlite.insert
        made = self.session.scalar(insert(OrbitRow).values(values).on_conflict_do_nothing().returning(OrbitRow))
        if made is not None:
            return made, True
        same = select(OrbitRow).where(OrbitRow.satellite_id == self.satellite_id, OrbitRow.sha256 == values["sha256"])
        return self.session.scalars(same).one(), False

    def get(self, orbit_id: str) -> OrbitRow:
        """Return the orbit ``orbit_id``."""
        row = self.session.get(OrbitRow, orbit_id)
        if row is None or row.satellite_id != self.satellite_id:
            raise NotFoundError("no such orbit")
        return row

    def page(self, query: OrbitQuery) -> tuple[list[OrbitRow], str | None]:
        """Return a part of the orbits, the newest first."""
        statement = select(OrbitRow).where(OrbitRow.satellite_id == self.satellite_id)
        if query.format is not None:
            statement = statement.where(OrbitRow.format == query.format)
        return fetch_page(self.session, statement, (OrbitRow.epoch, OrbitRow.id), query)

    def around(self, begin: datetime, end: datetime, margin_days: float) -> list[OrbitRow]:
        """Return the orbits that may serve data from ``begin`` to ``end``, and the nearest on each side in any case."""
        own = select(OrbitRow).where(OrbitRow.satellite_id == self.satellite_id)
        free = own.where(OrbitRow.until.is_(None))
        margin = timedelta(days=margin_days)
        inside = free.where(OrbitRow.epoch.between(begin - margin, end + margin)).order_by(OrbitRow.epoch)
        covering = own.where(OrbitRow.epoch <= end, OrbitRow.until >= begin)
        before = free.where(OrbitRow.epoch <= begin).order_by(OrbitRow.epoch.desc()).limit(1)
        after = free.where(OrbitRow.epoch >= begin).order_by(OrbitRow.epoch).limit(1)
        found: dict[str, OrbitRow] = {}
        for statement in (before, after, covering.limit(MOST_CANDIDATES), inside.limit(MOST_CANDIDATES)):
            found |= {row.id: row for row in self.session.scalars(statement)}
        return sorted(found.values(), key=lambda row: (row.epoch, row.id))
