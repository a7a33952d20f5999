"""Retention: raw bytes and chunks go after so many days, where a satellite says so; parameter sets stay for ever."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from functools import partial

from sqlalchemy import select
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
        return [
            Expired(row.id, row.satellite_id, str(row.data_until), row.size_bytes) for row in _expired_rows(session)
        ]


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


def _expired_rows(session: Session) -> list[TelemetrySession]:
    found: list[TelemetrySession] = []
    for satellite in session.scalars(select(Satellite).where(Satellite.retention_days.is_not(None))):
        before = utc_now() - timedelta(days=satellite.retention_days or 0)
        own = select(TelemetrySession).where(
            TelemetrySession.satellite_id == satellite.id,
            TelemetrySession.state == "closed",
            TelemetrySession.raw_removed_at.is_(None),
            TelemetrySession.data_until < before,
        )
        found.extend(session.scalars(own.order_by(TelemetrySession.id)))
    return found
