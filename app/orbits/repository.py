"""Orbits, as far as the caller's key reaches; equal ones are kept once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import NotFoundError
from app.http.paging import fetch_page
from app.orbits.parsing import ParsedOrbit
from app.orbits.schemas import OrbitQuery
from app.orbits.tables import OrbitRow
from app.satellites.repository import SatelliteRepository
from app.storage.database import new_id, utc_now
from app.storage.store import digest

MOST_CANDIDATES: Final = 400
ROWS_AT_ONCE: Final = 500
"""Orbits that one statement asks for."""


class OrbitRepository:
    """The orbits of one satellite that a caller reaches."""

    def __init__(self, session: Session, caller: Caller, satellite_id: str) -> None:
        self.session = session
        self.caller = caller
        self.satellite_id = SatelliteRepository(session, caller).get(satellite_id).id

    def add(self, orbits: Sequence[ParsedOrbit]) -> tuple[list[OrbitRow], bool]:
        """Return the rows of ``orbits`` in their order, and whether any of them is new."""
        digests = [digest(orbit.content.encode()) for orbit in orbits]
        wanted = dict(zip(digests, orbits, strict=True))
        known = self._by_digest(list(wanted))
        new = {sha256: orbit for sha256, orbit in wanted.items() if sha256 not in known}
        if new:
            self._insert(new)
            known |= self._by_digest(list(new))
            record_event(self.session, self.caller, "orbit.create", known[digests[0]].id, self.satellite_id)
        return [known[sha256] for sha256 in digests], bool(new)

    def _by_digest(self, digests: Sequence[str]) -> dict[str, OrbitRow]:
        own = select(OrbitRow).where(OrbitRow.satellite_id == self.satellite_id)
        parts = (digests[i : i + ROWS_AT_ONCE] for i in range(0, len(digests), ROWS_AT_ONCE))
        rows = (row for part in parts for row in self.session.scalars(own.where(OrbitRow.sha256.in_(part))))
        return {row.sha256: row for row in rows}

    def _insert(self, orbits: Mapping[str, ParsedOrbit]) -> None:
        """Keep ``orbits``; those that another request has kept meanwhile are passed over."""
        now = utc_now()
        values = [
            {
                "id": new_id(),
                "satellite_id": self.satellite_id,
                "format": orbit.format,
                "name": orbit.name,
                "epoch": orbit.epoch,
                "until": orbit.until,
                "content": orbit.content,
                "sha256": sha256,
                "details": orbit.details,
                "created_at": now,
                "created_by": self.caller.key_id,
            }
            for sha256, orbit in orbits.items()
        ]
        insert = postgresql.insert if self.session.get_bind().dialect.name == "postgresql" else sqlite.insert
        self.session.execute(insert(OrbitRow).on_conflict_do_nothing(), values)

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
