"""Retention: raw bytes and chunks go after so many days, where a satellite says so; parameter sets stay for ever."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM
from app.satellites.tables import Satellite
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database import Database, utc_now
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
    """Return the sessions whose bytes have been removed; their records and parameter sets stay."""
    removed = expired(database)
    for one in removed:
        with database.write() as session:
            row = session.get_one(TelemetrySession, one.session_id)
            row.raw_removed_at = utc_now()
            shared = _shared(session, row)
            for chunk in session.scalars(select(Chunk).where(Chunk.session_id == row.id)):
                store.delete(session, columns_key(row.id, chunk.sequence))
                if chunk.sha256 not in shared:
                    store.delete(session, raw_key(row.satellite_id, chunk.sha256))
            record_event(session, SYSTEM, "session.expire", row.id, row.satellite_id)
    return removed


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


def _shared(session: Session, row: TelemetrySession) -> set[str]:
    """Return the bytes that another session of the satellite still needs."""
    other = (
        select(Chunk.sha256)
        .join(TelemetrySession)
        .where(
            TelemetrySession.satellite_id == row.satellite_id,
            TelemetrySession.id != row.id,
            TelemetrySession.raw_removed_at.is_(None),
        )
    )
    return set(session.scalars(other))
