"""HTTP of confirmation: which telemetry is kept, asked by a station for many files at once."""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated

from fastapi import APIRouter
from pydantic import Field, StringConstraints
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.authentication import Station
from app.http.dependencies import Blobs, Db
from app.http.schemas import Body, Record, Slug
from app.http.strict_json import StrictJsonRoute
from app.satellites.repository import SatelliteRepository
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.identity import found_identity
from app.storage.store import Store, raw_key

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])

Digest = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]


class ConfirmBody(Body):
    """Which telemetry is asked for."""

    magnetometer: Slug
    sha256: list[Digest] = Field(max_length=1000, description="SHA-256 of the bytes that were sent, hexadecimal.")


class ConfirmRead(Record):
    """What of it is kept; what stands in neither list is to be sent again."""

    database: str = Field(description="Id of the service's database: another one was never sent to.")
    held: list[str] = Field(description="Kept, with their bytes.")
    expired: list[str] = Field(description="Kept until their retention, and not to be sent again.")


@router.post("/satellites/{satellite_id}/sessions/confirm")
def confirm_sessions(satellite_id: str, body: ConfirmBody, caller: Station, db: Db, store: Blobs) -> ConfirmRead:
    """Say which telemetry is kept, by the SHA-256 of its bytes; the objects are looked for, and not read."""
    with db.read() as session:
        SatelliteRepository(session, caller).magnetometer(satellite_id, body.magnetometer)
        row = found_identity(session)
        held, expired = _kept(session, store, satellite_id, body)
    return ConfirmRead(database="" if row is None else row.database_id, held=held, expired=expired)


def _kept(session: Session, store: Store, satellite_id: str, body: ConfirmBody) -> tuple[list[str], list[str]]:
    """Return which digests are of sessions with all their bytes, and which of sessions past their retention."""
    own = (
        TelemetrySession.satellite_id == satellite_id,
        TelemetrySession.magnetometer_id == body.magnetometer,
        TelemetrySession.sha256.in_(body.sha256),
    )
    asked = select(TelemetrySession.sha256, TelemetrySession.raw_removed_at, Chunk.sha256.label("chunk"))
    chunks: defaultdict[str, list[str]] = defaultdict(list)
    expired: set[str] = set()
    for row in session.execute(asked.join(Chunk).where(*own)):
        chunks[row.sha256].append(raw_key(satellite_id, row.chunk))
        if row.raw_removed_at is not None:
            expired.add(row.sha256)
    there = store.has(session, [key for sha256, keys in chunks.items() if sha256 not in expired for key in keys])
    held = [sha256 for sha256, keys in chunks.items() if sha256 not in expired and there.issuperset(keys)]
    return sorted(held), sorted(expired)
