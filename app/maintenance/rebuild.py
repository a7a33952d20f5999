"""Make every derived form of telemetry again from the raw bytes, which never change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from sqlalchemy import select

from app.errors import StoredObjectCorruptError
from app.satellites.tables import Magnetometer
from app.sessions.chunk_format import encode
from app.sessions.sensor_reading import SensorReading
from app.sessions.tables import Chunk, TelemetrySession
from app.settings import Settings
from app.storage.database import Database
from app.storage.database_store import is_whole
from app.storage.migration import require_head
from app.storage.object_locks import hold_objects
from app.storage.retry import retried
from app.storage.store import Store, columns_key, digest, raw_key
from magcal_core.errors import InputError


@dataclass(frozen=True, slots=True)
class Unbuilt:
    """A chunk that could not be read again, and why."""

    session_id: str
    sequence: int
    why: str


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """How many chunks were read again, how many of their columnar forms were wrong or gone, which had no bytes.

    ``failed`` are those whose raw bytes are gone, changed, or cannot be read by this version.
    """

    chunks: int
    changed: int
    without_bytes: int
    failed: tuple[Unbuilt, ...] = ()


def rebuild(
    database: Database, store: Store, settings: Settings, *, progress: Callable[[int], None] | None = None
) -> Rebuilt:
    """Read the raw bytes of every chunk again and replace the columnar forms that are not what the bytes give.

    A chunk that cannot be read again is told at the end; the others are done all the same.
    """
    require_head(database)
    with database.read() as session:
        rows = session.execute(select(Chunk.session_id, Chunk.sequence).order_by(Chunk.session_id, Chunk.sequence))
        places = [(row[0], row[1]) for row in rows]
    changed = without_bytes = 0
    failed = []
    for number, place in enumerate(places, start=1):
        try:
            outcome = retried(partial(_rebuild_chunk, database, store, settings, place))
        except (StoredObjectCorruptError, InputError) as error:
            failed.append(Unbuilt(*place, f"{error.code}: {error.message}"))
        else:
            changed += outcome is True
            without_bytes += outcome is None
        if progress is not None:
            progress(number)
    return Rebuilt(len(places), changed, without_bytes, tuple(failed))


def _rebuild_chunk(database: Database, store: Store, settings: Settings, place: tuple[str, int]) -> bool | None:
    """Return whether the columnar form was made anew; None where its raw bytes have been removed, or it has itself."""
    with database.write() as session:
        row = session.get(TelemetrySession, place[0])
        if row is None:
            return None
        hold_objects(session, [row.satellite_id])
        session.refresh(row, with_for_update=True)
        chunk = session.get_one(Chunk, place)
        if row.raw_removed_at is not None:
            return None
        magnetometer = session.get_one(Magnetometer, (row.satellite_id, row.magnetometer_id))
        raw = store.get(session, raw_key(row.satellite_id, chunk.sha256), chunk.sha256)
        columns = encode(
            SensorReading.of_chunk(chunk.reading, magnetometer).read(raw, chunk.media_type, settings).samples
        )
        key, sha256 = columns_key(*place), digest(columns)
        if sha256 == chunk.columns_sha256 and is_whole(store, session, key, sha256):
            return False
        store.replace(session, key, store.pack(columns, sha256))
        chunk.columns_sha256 = sha256
        return True
