"""Bytes that a session has lost come back when they are sent again."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database_store import is_whole as is_object_whole
from app.storage.database_store import keep_after_all
from app.storage.store import Packed, Store, columns_key, raw_key


@dataclass(frozen=True, slots=True)
class Sent:
    """A chunk that was sent again: its bytes, their columnar form, how many samples they are and how they were read."""

    raw: Packed
    columns: Packed
    samples: int
    reading: dict[str, object] | None


def is_whole(session: Session, row: TelemetrySession, sha256: str, store: Store) -> bool:
    """Return whether the bytes ``sha256`` of a session, and what was made of them, are there; they are read."""
    if row.raw_removed_at is not None:
        return False
    chunk = session.scalar(select(Chunk).where(Chunk.session_id == row.id, Chunk.sha256 == sha256))
    return chunk is None or _has_bytes(session, row, chunk, store)


def _has_bytes(session: Session, row: TelemetrySession, chunk: Chunk, store: Store) -> bool:
    raw = raw_key(row.satellite_id, chunk.sha256)
    columns = columns_key(row.id, chunk.sequence)
    return is_object_whole(store, session, raw, chunk.sha256) and is_object_whole(
        store, session, columns, chunk.columns_sha256
    )


def restore(session: Session, caller: Caller, row: TelemetrySession, sent: Sent, store: Store) -> bool:
    """Return whether bytes that the session had lost are now kept again: removed, gone or not those of its row.

    A session whose bytes were removed counts as removed until every one of its chunks has come again.
    """
    sha256 = sent.raw.sha256
    if is_whole(session, row, sha256, store):
        return False
    session.refresh(row, with_for_update=True)
    chunks = session.scalars(select(Chunk).where(Chunk.session_id == row.id)).all()
    chunk = next((one for one in chunks if one.sha256 == sha256), None)
    if chunk is None or (row.raw_removed_at is None and _has_bytes(session, row, chunk, store)):
        return False
    objects = {
        raw_key(row.satellite_id, sha256): sent.raw,
        columns_key(row.id, chunk.sequence): sent.columns,
    }
    for key, content in objects.items():
        store.replace(session, key, content)
    row.samples += sent.samples - chunk.samples
    chunk.samples, chunk.columns_sha256, chunk.reading = sent.samples, sent.columns.sha256, sent.reading
    keep_after_all(session, list(objects))
    if row.raw_removed_at is not None and all(_has_bytes(session, row, one, store) for one in chunks):
        row.raw_removed_at = None
    record_event(session, caller, "session.restore", row.id, row.satellite_id)
    session.flush()
    return True
