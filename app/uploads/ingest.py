"""From a body that has arrived whole to a session that is durable: read, kept, acknowledged, in that order.

`app.uploads.batching` says in which threads, and which uploads share a transaction.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import SYSTEM, Caller
from app.access.idempotency import fingerprint, made_with, recall, remember
from app.errors import ConflictError, ExpiredError
from app.http.receiving import Upload
from app.jobs.queue import Queue
from app.jobs.repository import JobRepository
from app.jobs.schemas import CalibrationBody
from app.metrics import UPLOAD_BYTES
from app.orbits.repository import OrbitRepository
from app.outbox.events import Event, session_received
from app.outbox.log import append
from app.satellites.repository import SatelliteRepository
from app.satellites.schemas import Policy
from app.satellites.tables import Magnetometer
from app.sessions.parsed import Parsed
from app.sessions.repository import SessionRepository, Writing
from app.sessions.restoration import is_whole, restore
from app.sessions.schemas import UploadQuery
from app.sessions.sensor_reading import SensorReading, format_of
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import Database
from app.storage.object_locks import hold_objects
from app.storage.retry import retried
from app.storage.store import Store, raw_key
from magcal_core.errors import TimeError
from magcal_core.telemetry import Telemetry, format_of_bytes
from magcal_core.telemetry.compression import decompress
from magcal_core.telemetry.time_guesses import spans_of

PACKED_BESIDE_BYTES: Final = 1 << 20
"""A larger body is compressed while it is parsed."""
PACKERS: Final = ThreadPoolExecutor(2, "pack")


@dataclass(frozen=True, slots=True)
class Kept:
    """What an upload became: its session, whether it is new, and the job that a policy queued.

    ``is_restored`` tells of a session that was there, but not its bytes, which now are.
    """

    session: TelemetrySession
    is_new: bool
    job_id: str | None = None
    is_restored: bool = False


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
        epoch = () if self.query.epoch_text is None else (self.query.epoch_text,)
        where = (self.satellite_id, self.query.magnetometer, str(self.query.open), *epoch)
        return fingerprint("POST sessions", *where, self.upload.sha256)

    @property
    def order(self) -> tuple[str, str, str]:
        """Where the upload stands among those of one transaction: the same in every process, lest they deadlock."""
        return self.satellite_id, self.query.magnetometer, self.upload.sha256


@dataclass(frozen=True, slots=True)
class Prepared:
    """An upload that has been read, and is ready to be written.

    ``parsed`` is None where it opens a session without samples, and where it only gives a session that is there, whole,
    one more Idempotency-Key.
    """

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
            is_kept = found is not None and is_whole(session, found, asked.upload.sha256, self._store)
        if found is not None:
            self._check_epoch(found, asked)
        if found is not None and is_kept and asked.key is None:
            return Kept(found, is_new=False)
        parsed = None
        if not is_kept:
            parsed = self._parsed(magnetometer, asked.upload, asked.query.epoch_text, may_be_empty=asked.query.open)
        return Prepared(asked, magnetometer, parsed)

    def _check_epoch(self, found: TelemetrySession, asked: Asked) -> None:
        """Raise ConflictError where the bytes of an upload are there already, read from another instant of boot."""
        if asked.query.epoch_text is None:
            return
        with self._database.read() as session:
            readings = [chunk.reading for chunk in SessionRepository(session, asked.caller).chunks(found.id)]
        epochs = {str(reading.get("time_epoch")) for reading in readings if reading is not None}
        if epochs - {asked.query.epoch_text}:
            raise ConflictError(
                "the same bytes are a session already, with another instant that their times count from"
            )

    def write(self, session: Session, uploads: Sequence[Prepared]) -> list[Kept]:
        """Return what ``uploads`` are kept as once the transaction of ``session`` is durable."""
        hold_objects(session, (one.asked.satellite_id for one in uploads))
        writing = Writing()
        kept = [self._create(session, one, writing) for one in uploads]
        writing.write(session, self._store)
        append(session, [_received(one.session) for one in kept if one.is_new and one.session.state == "closed"])
        return [
            replace(its, job_id=self._follow_policy(session, one.asked.caller, one.magnetometer, its.session))
            if its.is_new
            else its
            for one, its in zip(uploads, kept, strict=True)
        ]

    def _create(self, session: Session, prepared: Prepared, writing: Writing) -> Kept:
        asked, parsed = prepared.asked, prepared.parsed
        sessions = SessionRepository(session, asked.caller)
        # Equal bytes are found by the insert itself; only what a key made has to be looked for.
        made = recall(session, asked.caller, asked.key, asked.fingerprint)
        row = None if made is None else sessions.get(made)
        if row is None and parsed is None and not asked.query.open:
            row = sessions.find_content(asked.satellite_id, asked.query.magnetometer, asked.upload.sha256)
            if row is None:
                raise ConflictError("the session was removed while the upload was read")
        is_new = False
        if row is None:
            row, is_new = sessions.create(
                asked.satellite_id, prepared.magnetometer.id, parsed, writing, is_open=asked.query.open
            )
        is_restored = not is_new and parsed is not None and restore(session, asked.caller, row, parsed, self._store)
        if asked.key is not None and made is None:
            remember(session, asked.caller, asked.key, asked.fingerprint, row.id)
        return Kept(row, is_new, is_restored=is_restored)

    def tell(self, prepared: Prepared, kept: Kept) -> None:
        """Count an upload that is durable, and wake whoever waits for its job."""
        if kept.is_new or kept.is_restored:
            UPLOAD_BYTES.inc(prepared.size_bytes)
        if kept.job_id is not None:
            self._queue.announce()

    def append(
        self, caller: Caller, session_id: str, upload: Upload, time_epoch: str | None = None
    ) -> TelemetrySession:
        """Return the session ``session_id`` with a further chunk."""
        with self._database.read() as session:
            row = SessionRepository(session, caller).get(session_id)
            magnetometer = SatelliteRepository(session, caller).magnetometer(row.satellite_id, row.magnetometer_id)
        parsed = self._parsed(magnetometer, upload, time_epoch, may_be_empty=False)
        return retried(lambda: self._add(caller, session_id, parsed))

    def _add(self, caller: Caller, session_id: str, parsed: Parsed | None) -> TelemetrySession:
        with self._database.write() as session:
            sessions = SessionRepository(session, caller)
            row = sessions.get(session_id)
            hold_objects(session, [row.satellite_id])
            session.refresh(row, with_for_update=True)
            if parsed is not None:
                sessions.append(row, parsed, self._store)
            return row

    def read_again(self, caller: Caller, session_id: str) -> TelemetrySession:
        """Return the session ``session_id``, its bytes read anew as its magnetometer is read now."""
        with self._database.read() as session:
            sessions = SessionRepository(session, caller)
            row = sessions.get(session_id)
            if row.raw_removed_at is not None:
                raise ExpiredError("the telemetry is past its satellite's retention and has been removed")
            magnetometer = SatelliteRepository(session, caller).magnetometer(row.satellite_id, row.magnetometer_id)
            sensor = SensorReading.of(magnetometer)
            keys = [(chunk, raw_key(row.satellite_id, chunk.sha256)) for chunk in sessions.chunks(session_id)]
            raw = [(chunk, self._store.get(session, key, chunk.sha256)) for chunk, key in keys]
        anew = [
            Parsed.of(
                Upload(content, chunk.sha256, chunk.media_type),
                (own := sensor.with_epoch_of(chunk.reading)).read(content, chunk.media_type, self._settings),
                chunk.format,
                self._store,
                reading=own.to_dict(),
            )
            for chunk, content in raw
        ]
        return retried(lambda: self._replace(caller, session_id, anew))

    def _replace(self, caller: Caller, session_id: str, anew: Sequence[Parsed]) -> TelemetrySession:
        with self._database.write() as session:
            sessions = SessionRepository(session, caller)
            row = sessions.get(session_id)
            hold_objects(session, [row.satellite_id])
            session.refresh(row, with_for_update=True)
            sessions.read_as(row, anew, self._store)
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
            append(session, [_received(row)] if is_open else [])
            job_id = self._follow_policy(session, caller, magnetometer, row) if is_open else None
        if job_id is not None:
            self._queue.announce()
        return Kept(row, is_open, job_id)

    def _find(self, session: Session, asked: Asked) -> TelemetrySession | None:
        made = None if asked.key is None else made_with(session, asked.caller, asked.key, asked.fingerprint)
        sessions = SessionRepository(session, asked.caller)
        if made is not None:
            return sessions.get(made)
        if asked.query.open:
            return None
        return sessions.find_content(asked.satellite_id, asked.query.magnetometer, asked.upload.sha256)

    def _parsed(
        self, magnetometer: Magnetometer, upload: Upload, time_epoch: str | None, *, may_be_empty: bool
    ) -> Parsed | None:
        if may_be_empty and not upload.content:
            return None
        is_large = len(upload.content) > PACKED_BESIDE_BYTES
        packing = PACKERS.submit(self._store.pack, upload.content, upload.sha256) if is_large else None
        sensor = SensorReading.of(magnetometer)
        sensor = sensor if time_epoch is None else replace(sensor, time_epoch=time_epoch)
        telemetry = self._read(sensor, magnetometer, upload)
        form = format_of(upload.media_type) or format_of_bytes(decompress(upload.content))
        packed = None if packing is None else packing.result()
        return Parsed.of(upload, telemetry, form, self._store, packed, reading=sensor.to_dict())

    def _read(self, sensor: SensorReading, magnetometer: Magnetometer, upload: Upload) -> Telemetry:
        """Return the telemetry of an upload; of times that cannot be read, the forms that suit the orbits are named."""
        try:
            return sensor.read(upload.content, upload.media_type, self._settings)
        except TimeError:
            with self._database.read() as session:
                spans = spans_of(OrbitRepository(session, SYSTEM, magnetometer.satellite_id).instants())
            if not spans:
                raise
            return sensor.read(upload.content, upload.media_type, self._settings, spans)

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


def _received(row: TelemetrySession) -> Event:
    return session_received(
        session_id=row.id,
        satellite_id=row.satellite_id,
        magnetometer_id=row.magnetometer_id,
        samples=row.samples,
        data_from=row.data_from,
        data_until=row.data_until,
    )
