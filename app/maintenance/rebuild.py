"""Make every derived form of telemetry again from the raw bytes, which never change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import select

from app.errors import StoredObjectCorruptError
from app.satellites.tables import Magnetometer
from app.sessions.chunk_format import encode
from app.sessions.sensor_reading import SensorReading
from app.sessions.tables import Chunk, TelemetrySession
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import require_head
from app.storage.store import Store, columns_key, digest, raw_key


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """How many chunks were read again, how many of their columnar forms were wrong or gone, and which had no bytes."""

    chunks: int
    changed: int
    without_bytes: int


def rebuild(
    database: Database, store: Store, settings: Settings, *, progress: Callable[[int], None] | None = None
) -> Rebuilt:
    """Read the raw bytes of every chunk again and replace the columnar forms that are not what the bytes give.

    Raises
    ------
    StoredObjectCorruptError
        Raw bytes are gone or changed: `audit` lists them all, a backup has them.
    """
    require_head(database)
    with database.read() as session:
        rows = session.execute(select(Chunk.session_id, Chunk.sequence).order_by(Chunk.session_id, Chunk.sequence))
        places = [(row[0], row[1]) for row in rows]
    changed = without_bytes = 0
    for number, place in enumerate(places, start=1):
        outcome = _rebuild_chunk(database, store, settings, place)
        changed += outcome is True
        without_bytes += outcome is None
        if progress is not None:
            progress(number)
    return Rebuilt(len(places), changed, without_bytes)


def _rebuild_chunk(database: Database, store: Store, settings: Settings, place: tuple[str, int]) -> bool | None:
    """Return whether the columnar form was made anew; None where retention has removed the raw bytes."""
    with database.write() as session:
        chunk = session.get_one(Chunk, place)
        row = session.get_one(TelemetrySession, chunk.session_id)
        if row.raw_removed_at is not None:
            return None
        magnetometer = session.get_one(Magnetometer, (row.satellite_id, row.magnetometer_id))
        raw = store.get(session, raw_key(row.satellite_id, chunk.sha256), chunk.sha256)
        columns = encode(SensorReading.of(magnetometer).read(raw, chunk.media_type, settings).samples)
        key, sha256 = columns_key(*place), digest(columns)
        if sha256 == chunk.columns_sha256 and _is_whole(database, store, key, sha256):
            return False
        store.delete(session, key)
        chunk.columns_sha256 = store.put(session, key, columns)
        return True


def _is_whole(database: Database, store: Store, key: str, sha256: str) -> bool:
    with database.read() as session:
        try:
            store.get(session, key, sha256)
        except StoredObjectCorruptError:
            return False
    return True
