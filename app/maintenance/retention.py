"""Retention: raw bytes and chunks go after so many days, where a satellite says so; parameter sets stay for ever."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial

from sqlalchemy import Row, literal_column, select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM
from app.maintenance.removal import remove_objects
from app.satellites.tables import Satellite
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database import Database, utc_now
from app.storage.database_store import remove_later
from app.storage.retry import retried
from app.storage.store import Store, columns_key, raw_key


@dataclass(frozen=True, slots=True)
class Expired:
    """A session whose bytes are past their satellite's retention."""

    session_id: str
    satellite_id: str
    data_until: str
    size_bytes: int


def expired(database: Database) -> list[Expired]:
    """Return the sessions whose bytes may go."""
    with database.read() as session:
        return [Expired(one, place, str(until), size) for one, place, until, size in _expired_rows(session)]


def remove_expired(database: Database, store: Store) -> list[Expired]:
    """Return the sessions whose bytes have been removed; their records and parameter sets stay.

    What a run before this one said and was killed before it did is done too.
    """
    removed = [one for one in expired(database) if retried(partial(_expire, database, one.session_id))]
    remove_objects(database, store)
    return removed


def _expire(database: Database, session_id: str) -> bool:
    """Return whether a session has been marked as removed, its objects as to be removed: it may have changed since."""
    with database.write() as session:
        row = session.get_one(TelemetrySession, session_id, with_for_update=True)
        satellite = session.get_one(Satellite, row.satellite_id)
        if satellite.retention_days is None or row.raw_removed_at is not None or row.data_until is None:
            return False
        if row.data_until >= utc_now() - timedelta(days=satellite.retention_days):
            return False
        row.raw_removed_at = utc_now()
        chunks = session.scalars(select(Chunk).where(Chunk.session_id == row.id)).all()
        keys = [
            key
            for chunk in chunks
            for key in (raw_key(row.satellite_id, chunk.sha256), columns_key(row.id, chunk.sequence))
        ]
        remove_later(session, row.satellite_id, keys)
        record_event(session, SYSTEM, "session.expire", row.id, row.satellite_id)
        return True


def _expired_rows(session: Session) -> list[Row[str, str, datetime | None, int]]:
    """Return id, satellite, end and size of the sessions that are past their retention, by satellite and end.

    One look for each retention that there is: an index has the sessions that are kept by their satellite and end.
    """
    row_of = TelemetrySession
    found: list[Row[str, str, datetime | None, int]] = []
    retentions = select(Satellite.retention_days).where(Satellite.retention_days.is_not(None)).distinct()
    for days in session.scalars(retentions.order_by(Satellite.retention_days)):
        own = select(Satellite.id).where(Satellite.retention_days == days)
        past = select(row_of.id, row_of.satellite_id, row_of.data_until, row_of.size_bytes).where(
            row_of.satellite_id.in_(own),
            row_of.state == literal_column("'closed'"),  # not a parameter: SQLite would not use the index of these
            row_of.raw_removed_at.is_(None),
            row_of.data_until < utc_now() - timedelta(days=days or 0),
        )
        found.extend(session.execute(past.order_by(row_of.satellite_id, row_of.data_until, row_of.id)))
    return found
