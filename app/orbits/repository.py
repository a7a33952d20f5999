"""Orbits, as far as the caller's key reaches; equal ones are kept once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
from sqlalchemy import Integer, Select, bindparam, select, union_all
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import NotFoundError
from app.http.paging import Part, Ways, fetch_page
from app.http.schemas import utc_text
from app.orbits.parsing import ParsedOrbit
from app.orbits.schemas import OrbitQuery
from app.orbits.tables import OrbitRow
from app.satellites.repository import SatelliteRepository
from app.storage.database import new_id, utc_now
from app.storage.store import digest
from magcal_core.errors import OptionError

ORBITS: Final = Ways(
    {"epoch": (OrbitRow.epoch, OrbitRow.id), "created": (OrbitRow.created_at, OrbitRow.id)},
    searched=(OrbitRow.id, OrbitRow.name, OrbitRow.format, OrbitRow.details["norad_id"].as_string()),
)
MOST_EPHEMERIDES: Final = 400
"""Ephemerides, of some megabytes each, that one calibration takes."""
MOST_STATES: Final = 20_000
"""TLEs, OMMs and state vectors that one calibration takes: four a day for thirteen years."""
MOST_INSTANTS: Final = 400
"""Epochs that a time which cannot be read is held against: the newest ones."""
NEAR_DAYS: Final = 1.0
ROWS_AT_ONCE: Final = 500
"""Orbits that one statement asks for."""


def _core_time(instant: datetime) -> np.datetime64:
    return np.datetime64(instant.astimezone(UTC).replace(tzinfo=None), "ns")


def _around() -> Select[OrbitRow]:
    """Return the statement for the orbits that may serve some data: see `OrbitRepository.around`."""
    row = OrbitRow
    since, till = bindparam("since", type_=row.epoch.type), bindparam("till", type_=row.epoch.type)
    from_epoch, to_epoch = (bindparam(name, type_=row.epoch.type) for name in ("from_epoch", "to_epoch"))
    own = select(row.id).where(row.satellite_id == bindparam("of"), row.withdrawn_at.is_(None))
    free = own.where(row.until.is_(None))
    parts = (
        free.where(row.epoch <= since).order_by(row.epoch.desc()).limit(1),
        free.where(row.epoch >= till).order_by(row.epoch).limit(1),
        own.where(row.epoch <= till, row.until >= since).limit(bindparam("ephemerides", type_=Integer)),
        free.where(row.epoch.between(from_epoch, to_epoch)).limit(bindparam("states", type_=Integer)),
    )
    return select(row).where(row.id.in_(union_all(*(select(part.subquery().c.id) for part in parts))))


AROUND: Final = _around()
"""Made once: to make it costs more than to execute it."""


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

    def withdraw(self, orbit_id: str) -> OrbitRow:
        """Return the orbit ``orbit_id``, which no calibration takes from now on; what was made with it keeps it."""
        row = self.get(orbit_id)
        if row.withdrawn_at is None:
            row.withdrawn_at, row.withdrawn_by = utc_now(), self.caller.key_id
            record_event(self.session, self.caller, "orbit.withdraw", row.id, self.satellite_id)
        return row

    def restore(self, orbit_id: str) -> OrbitRow:
        """Return the orbit ``orbit_id``, in use again; to send it again does not do that."""
        row = self.get(orbit_id)
        if row.withdrawn_at is not None:
            row.withdrawn_at = row.withdrawn_by = None
            record_event(self.session, self.caller, "orbit.restore", row.id, self.satellite_id)
        return row

    def page(self, query: OrbitQuery) -> Part[OrbitRow]:
        """Return a part of the orbits."""
        statement = select(OrbitRow).where(OrbitRow.satellite_id == self.satellite_id)
        if query.format is not None:
            statement = statement.where(OrbitRow.format == query.format)
        return fetch_page(self.session, statement, ORBITS, query)

    def instants(self) -> list[tuple[np.datetime64, np.datetime64 | None]]:
        """Return epoch, and end of an ephemeris, of the satellite's orbits, the newest first."""
        statement = select(OrbitRow.epoch, OrbitRow.until).where(OrbitRow.satellite_id == self.satellite_id)
        rows = self.session.execute(statement.order_by(OrbitRow.epoch.desc()).limit(MOST_INSTANTS))
        return [(_core_time(epoch), None if until is None else _core_time(until)) for epoch, until in rows]

    def around(self, begin: datetime, end: datetime, margin_days: float) -> list[OrbitRow]:
        """Return every orbit that may serve data from ``begin`` to ``end``, in the order of their epochs.

        These are the ephemerides that cover a part of them, the states and elements with epochs among them and up to a
        day around them (at most ``margin_days``), and the nearest one on each side in any case: farther ones are never
        the nearest to any of the data, also where their clock is off.

        Raises
        ------
        OptionError
            There are more of them than one calibration takes; none is left out silently.
        """
        margin = timedelta(days=min(margin_days, NEAR_DAYS))
        asked = {
            "of": self.satellite_id, "since": begin, "till": end, "from_epoch": begin - margin,
            "to_epoch": end + margin, "ephemerides": MOST_EPHEMERIDES + 1, "states": MOST_STATES + 1,
        }  # fmt: skip
        found = self.session.scalars(AROUND, asked).all()
        covering = [row for row in found if row.until is not None]
        inside = [row for row in found if row.until is None and begin - margin <= row.epoch <= end + margin]
        for rows, most, kind in ((covering, MOST_EPHEMERIDES, "ephemerides"), (inside, MOST_STATES, "TLEs")):
            if len(rows) > most:
                raise OptionError(
                    f"more than {most} {kind} serve the data from {utc_text(begin)} to {utc_text(end)}: calibrate less "
                    "of them at a time"
                )
        return sorted(found, key=lambda row: (row.epoch, row.id))
