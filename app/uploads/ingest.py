"""From a body that has arrived whole to a session that is durable: read, kept, acknowledged, in that order.

`app.uploads.batching` says in which threads, and which uploads share a transaction.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.access.idempotency import fingerprint, recall, remember
from app.http.receiving import Upload
from app.jobs.queue import Queue
from app.jobs.repository import JobRepository
from app.jobs.schemas import CalibrationBody
from app.metrics import UPLOAD_BYTES
from app.satellites.repository import SatelliteRepository
from app.satellites.schemas import Policy
from app.satellites.tables import Magnetometer
from app.sessions.repository import Parsed, SessionRepository, Writing
from app.sessions.schemas import UploadQuery
from app.sessions.sensor_reading import SensorReading, format_of
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import Database
from app.storage.retry import retried
from app.storage.store import Store
from magcal_core.telemetry import format_of_bytes
from magcal_core.telemetry.compression import decompress

PACKED_BESIDE_BYTES: Final = 1 << 20
"""A larger body is compressed while it is parsed."""
PACKERS: Final = ThreadPoolExecutor(2, "pack")


@dataclass(frozen=True, slots=True)
class Kept:
    """What an upload became: its session, whether it is new, and the job that a policy queued."""

    session: TelemetrySession
    is_new: bool
    job_id: str | None = None


@dataclass(frozen=True, slots=True)
class Asked:
    """What an upload asks for, and who asks."""

    caller: Caller
    satellite_id: str
    query: UploadQuery
    upload: Upload
    key: str | None

    @property
    def fingerprint(self) -> str:
        """What makes the same upload the same."""
        where = (self.satellite_id, self.query.magnetometer, str(self.query.open))
        return fingerprint("POST sessions", *where, self.upload.sha256)

    @property
    def order(self) -> tuple[str, str, str]:
        """Where the upload stands among those of one transaction: the same in every process, lest they deadlock."""
        return self.satellite_id, self.query.magnetometer, self.upload.sha256


@dataclass(frozen=True, slots=True)
class Prepared:
    """An upload that has been read, and is ready to be written; None where it opens a session without samples."""

    asked: Asked
    magnetometer: Magnetometer
    parsed: Parsed | None

    @property
    def size_bytes(self) -> int:
        """How much its transaction writes of its body, about."""
        return len(self.asked.upload.content)


class Ingest:
    """The steps by which telemetry is kept."""

    def __init__(self, database: Database, store: Store, queue: Queue, settings: Settings) -> None:
        self._database = database
        self._store = store
        self._queue = queue
        self._settings = settings

    def prepare(self, asked: Asked) -> Prepared | Kept:
        """Return an upload, read and ready to be written, or what it was kept as before."""
        with self._database.read() as session:
            sessions = SessionRepository(session, asked.caller)
            sha256 = None if asked.query.open or asked.key is not None else asked.upload.sha256
            magnetometer, known = sessions.place_of(asked.satellite_id, asked.query.magnetometer, sha256)
            found = sessions.get(known) if known is not None else self._find(session, asked) if asked.key else None
        if found is not None and asked.key is None:
            return Kept(found, is_new=False)
        parsed = self._parsed(magnetometer, asked.upload, may_be_empty=asked.query.open) if found is None else None
        return Prepared(asked, magnetometer, parsed)

    def write(self, session: Session, uploads: Sequence[Prepared]) -> list[Kept]:
        """Return what ``uploads`` are kept as once the transaction of ``session`` is durable."""
        writing = Writing()
        rows = [self._create(session, one, writing) for one in uploads]
        writing.write(session, self._store)
        return [
            Kept(row, is_new, self._follow_policy(session, one.asked.caller, one.magnetometer, row) if is_new else None)
            for one, (row, is_new) in zip(uploads, rows, strict=True)
        ]

    def _create(self, session: Session, prepared: Prepared, writing: Writing) -> tuple[TelemetrySession, bool]:
        asked = prepared.asked
        # Equal bytes are found by the insert itself; only what a key made has to be looked for.
        row, is_new = (None if asked.key is None else self._find(session, asked)), False
        if row is None:
            row, is_new = SessionRepository(session, asked.caller).create(
                asked.satellite_id, prepared.magnetometer.id, prepared.parsed, writing, is_open=asked.query.open
            )
        if asked.key is not None:
            remember(session, asked.caller, asked.key, asked.fingerprint, row.id)
        return row, is_new

    def tell(self, prepared: Prepared, kept: Kept) -> None:
        """Count an upload that is durable, and wake whoever waits for its job."""
        if kept.is_new:
            UPLOAD_BYTES.inc(prepared.size_bytes)
        if kept.job_id is not None:
            self._queue.announce()

    def append(self, caller: Caller, session_id: str, upload: Upload) -> TelemetrySession:
        """Return the session ``session_id`` with a further chunk."""
        with self._database.read() as session:
            row = SessionRepository(session, caller).get(session_id)
            magnetometer = SatelliteRepository(session, caller).magnetometer(row.satellite_id, row.magnetometer_id)
        parsed = self._parsed(magnetometer, upload, may_be_empty=False)
        return retried(lambda: self._add(caller, session_id, parsed))

    def _add(self, caller: Caller, session_id: str, parsed: Parsed | None) -> TelemetrySession:
        with self._database.write() as session:
            sessions = SessionRepository(session, caller)
            row = sessions.get(session_id)
            session.refresh(row, with_for_update=True)
            if parsed is not None:
                sessions.append(row, parsed, self._store)
            return row

    def close(self, caller: Caller, session_id: str) -> Kept:
        """Return the session ``session_id``, closed, and the job that its magnetometer's policy queues."""
        with self._database.write() as session:
            sessions = SessionRepository(session, caller)
            row = sessions.get(session_id)
            session.refresh(row, with_for_update=True)
            is_open = row.state == "open"
            sessions.close(row)
            session.flush()
            satellites = SatelliteRepository(session, caller)
            magnetometer = satellites.magnetometer(row.satellite_id, row.magnetometer_id)
            job_id = self._follow_policy(session, caller, magnetometer, row) if is_open else None
        if job_id is not None:
            self._queue.announce()
        return Kept(row, is_open, job_id)

    def _find(self, session: Session, asked: Asked) -> TelemetrySession | None:
        made = recall(session, asked.caller, asked.key, asked.fingerprint)
        sessions = SessionRepository(session, asked.caller)
        if made is not None:
            return sessions.get(made)
        if asked.query.open:
            return None
        return sessions.find_content(asked.satellite_id, asked.query.magnetometer, asked.upload.sha256)

    def _parsed(self, magnetometer: Magnetometer, upload: Upload, *, may_be_empty: bool) -> Parsed | None:
        if may_be_empty and not upload.content:
            return None
        is_large = len(upload.content) > PACKED_BESIDE_BYTES
        packing = PACKERS.submit(self._store.pack, upload.content, upload.sha256) if is_large else None
        telemetry = SensorReading.of(magnetometer).read(upload.content, upload.media_type, self._settings)
        form = format_of(upload.media_type) or format_of_bytes(decompress(upload.content))
        return Parsed.of(upload, telemetry, form, self._store, None if packing is None else packing.result())

    def _follow_policy(
        self, session: Session, caller: Caller, magnetometer: Magnetometer, row: TelemetrySession
    ) -> str | None:
        if magnetometer.policy is None or row.state != "closed":
            return None
        policy = Policy.model_validate(magnetometer.policy)
        if not policy.calibrate:
            return None
        wanted = {"kind": "calibration", "session_ids": [row.id], "priority": policy.priority, **policy.options}
        body = CalibrationBody.model_validate(wanted)
        return JobRepository(session, caller).submit(body, self._queue).id
