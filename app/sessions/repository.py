"""Sessions and their chunks, as far as the caller's key reaches."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Final

from sqlalchemy import Select, and_, bindparam, func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.access.audit_trail import NEW_EVENT, event_of, record_event
from app.access.caller import Caller
from app.errors import ConflictError, ExpiredError, NotFoundError, QuotaError
from app.http.paging import Part, Ways, fetch_page
from app.satellites.repository import within_reach
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.chunk_format import decode
from app.sessions.parsed import Parsed
from app.sessions.restoration import restore
from app.sessions.schemas import SessionQuery
from app.sessions.tables import Chunk, SessionMonitoring, TelemetrySession
from app.storage.database import new_id, utc_now
from app.storage.store import Packed, Store, columns_key, raw_key
from magcal_core.samples import Samples
from magcal_core.telemetry import merge_samples

DAY: Final = timedelta(days=1)
REMOVED: Final = "the telemetry is past its satellite's retention and has been removed"
ARRIVED: Final = Ways(
    {"arrived": (TelemetrySession.id,)},
    searched=(TelemetrySession.id, TelemetrySession.satellite_id, TelemetrySession.magnetometer_id),
)
SESSIONS: Final = TelemetrySession.metadata.tables["session"]
CHUNKS: Final = Chunk.metadata.tables["chunk"]
"""Without the mapper, for what an upload writes while it holds the writer's turn."""
NEW_SESSION: Final = {
    name: insert(SESSIONS).on_conflict_do_nothing().returning(SESSIONS.c.id)
    for name, insert in (("sqlite", sqlite.insert), ("postgresql", postgresql.insert))
}
NEW_CHUNK: Final = CHUNKS.insert()
SATELLITES: Final = Satellite.metadata.tables["satellite"]
MAGNETOMETERS: Final = Magnetometer.metadata.tables["magnetometer"]
PLACE: Final = (
    select(SATELLITES.c.id, SESSIONS.c.id, MAGNETOMETERS)
    .select_from(SATELLITES)
    .outerjoin(
        MAGNETOMETERS,
        and_(MAGNETOMETERS.c.satellite_id == SATELLITES.c.id, MAGNETOMETERS.c.id == bindparam("magnetometer_id")),
    )
    .outerjoin(
        SESSIONS,
        and_(
            SESSIONS.c.satellite_id == MAGNETOMETERS.c.satellite_id,
            SESSIONS.c.magnetometer_id == MAGNETOMETERS.c.id,
            SESSIONS.c.sha256 == bindparam("sha256"),
        ),
    )
    .where(SATELLITES.c.id == bindparam("satellite_id"))
)
"""Satellite, magnetometer and session of certain bytes, as far as there are any: made once, asked in one go."""


NOTHING: Final[dict[str, object]] = {
    "data_from": None,
    "data_until": None,
    "samples": 0,
    "used_samples": 0,
    "size_bytes": 0,
    "columns": [],
    "quality": {},
}
"""What a session says of its telemetry before there is any."""


@dataclass(frozen=True, slots=True)
class Writing:
    """What uploads of one transaction write beside their sessions: one statement serves all of them."""

    objects: list[tuple[str, Packed]] = field(default_factory=list)
    chunks: list[dict[str, object]] = field(default_factory=list)
    events: list[dict[str, object]] = field(default_factory=list)

    def add(self, row: TelemetrySession, sequence: int, parsed: Parsed) -> None:
        """Add a chunk of the session ``row`` with its bytes and their columnar form."""
        self.objects.append((raw_key(row.satellite_id, parsed.raw.sha256), parsed.raw))
        self.objects.append((columns_key(row.id, sequence), parsed.columns))
        self.chunks.append(
            {
                "session_id": row.id,
                "sequence": sequence,
                "sha256": parsed.raw.sha256,
                "size_bytes": len(parsed.raw.content),
                "format": parsed.format,
                "media_type": parsed.media_type,
                "samples": len(parsed.telemetry.samples),
                "columns_sha256": parsed.columns.sha256,
                "reading": parsed.reading,
                "created_at": utc_now(),
            }
        )

    def write(self, session: Session, store: Store) -> None:
        """Write everything; the sessions are there."""
        store.put_all(session, self.objects)
        for statement, values in ((NEW_CHUNK, self.chunks), (NEW_EVENT, self.events)):
            if values:
                session.connection().execute(statement, values)


class SessionRepository:
    """The sessions that a caller reaches."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller

    def get(self, session_id: str) -> TelemetrySession:
        """Return the session ``session_id``."""
        reached = within_reach(TelemetrySession.satellite_id, self.caller)
        row = self.session.scalar(select(TelemetrySession).where(TelemetrySession.id == session_id, reached))
        if row is None:
            raise NotFoundError("no such session")
        return row

    def page(self, query: SessionQuery) -> Part[TelemetrySession]:
        """Return a part of the sessions."""
        return fetch_page(self.session, self._wanted(query), ARRIVED, query)

    def _wanted(self, query: SessionQuery) -> Select[TelemetrySession]:
        statement = select(TelemetrySession).where(within_reach(TelemetrySession.satellite_id, self.caller))
        equal = {
            TelemetrySession.satellite_id: query.satellite,
            TelemetrySession.magnetometer_id: query.magnetometer,
            TelemetrySession.state: query.state,
            TelemetrySession.sha256: query.sha256,
        }
        for column, wanted in equal.items():
            if wanted is not None:
                statement = statement.where(column == wanted)
        if query.since is not None:
            statement = statement.where(TelemetrySession.data_until >= query.since)
        if query.until is not None:
            statement = statement.where(TelemetrySession.data_from <= query.until)
        if query.agreement is not None:
            judged = select(SessionMonitoring.session_id).where(SessionMonitoring.grade == query.agreement)
            statement = statement.where(TelemetrySession.id.in_(judged))
        return statement

    def judgements(self, session_ids: Sequence[str]) -> dict[str, SessionMonitoring]:
        """Return what each of ``session_ids`` that was judged says of the set that was in force then."""
        rows = self.session.scalars(select(SessionMonitoring).where(SessionMonitoring.session_id.in_(session_ids)))
        return {row.session_id: row for row in rows}

    def judge(self, session_id: str, parameter_set_id: str, record: Mapping[str, object]) -> None:
        """Keep what a session says of the parameter set in force in place of what it said before."""
        row = self.session.get(SessionMonitoring, session_id)
        if row is None:
            row = SessionMonitoring(session_id=session_id)
            self.session.add(row)
        row.parameter_set_id, row.grade, row.judged_at = parameter_set_id, str(record["grade"]), utc_now()
        row.record = dict(record)
        row.residual_rms_nt = _number(record.get("residual_rms_nt"))
        row.residual_ratio = _number(record.get("residual_ratio"))

    def place_of(self, satellite_id: str, magnetometer_id: str, sha256: str | None) -> tuple[Magnetometer, str | None]:
        """Return the magnetometer of an upload, and the id of the session that its bytes are already, if there is one.

        Raises
        ------
        NotFoundError
            There is no such satellite within the caller's reach, or it has no such magnetometer.
        """
        asked = {"satellite_id": satellite_id, "magnetometer_id": magnetometer_id, "sha256": sha256}
        reaches = self.caller.reaches(satellite_id)
        row = self.session.connection().execute(PLACE, asked).first() if reaches else None
        if row is None:
            raise NotFoundError("no such satellite")
        _, known, *values = row
        magnetometer = Magnetometer(**dict(zip(MAGNETOMETERS.c.keys(), values, strict=True)))
        if magnetometer.id is None:
            raise NotFoundError("the satellite has no such magnetometer")
        return magnetometer, known

    def find_content(self, satellite_id: str, magnetometer_id: str, sha256: str) -> TelemetrySession | None:
        """Return the session that these bytes are already, if there is one."""
        return self.session.scalar(
            select(TelemetrySession).where(
                TelemetrySession.satellite_id == satellite_id,
                TelemetrySession.magnetometer_id == magnetometer_id,
                TelemetrySession.sha256 == sha256,
            )
        )

    def create(
        self, satellite_id: str, magnetometer_id: str, parsed: Parsed | None, writing: Writing, *, is_open: bool
    ) -> tuple[TelemetrySession, bool]:
        """Return the session of an upload, and whether it is new: of equal uploads, only one is.

        What else a new one needs is added to ``writing``.
        """
        sha256 = None if parsed is None or is_open else parsed.raw.sha256
        values: dict[str, object] = {
            "id": new_id(),
            "satellite_id": satellite_id,
            "magnetometer_id": magnetometer_id,
            "state": "open" if is_open else "closed",
            "sha256": sha256,
            "raw_removed_at": None,
            "created_at": utc_now(),
            "created_by": self.caller.key_id,
            "closed_at": None if is_open else utc_now(),
        }
        values |= NOTHING if parsed is None else parsed.added_to(None)
        connection = self.session.connection()
        if connection.execute(NEW_SESSION[connection.dialect.name], values).first() is None:
            found = self.find_content(satellite_id, magnetometer_id, sha256 or "")
            if found is None:
                raise ConflictError("the session was made and removed at the same time")
            return found, False
        row = TelemetrySession(**values)
        if parsed is not None:
            writing.add(row, 0, parsed)
        writing.events.append(event_of(self.caller, "session.create", row.id, satellite_id))
        return row, True

    def append(self, row: TelemetrySession, parsed: Parsed, store: Store) -> None:
        """Add a chunk to an open session; one that is there already, with its bytes, changes nothing."""
        chunks = self.chunks(row.id)
        if any(chunk.sha256 == parsed.raw.sha256 for chunk in chunks):
            restore(self.session, self.caller, row, parsed, store)
            return
        if row.state != "open":
            raise ConflictError("the session is closed")
        for name, value in parsed.added_to(row).items():
            setattr(row, name, value)
        writing = Writing()
        writing.add(row, len(chunks), parsed)
        writing.write(self.session, store)

    def read_as(self, row: TelemetrySession, anew: Sequence[Parsed], store: Store) -> None:
        """Replace what was read from the chunks of a session by ``anew``, one for each of them."""
        if row.raw_removed_at is not None:
            raise ExpiredError(REMOVED)
        chunks = self.chunks(row.id)
        if [chunk.sha256 for chunk in chunks] != [parsed.raw.sha256 for parsed in anew]:
            raise ConflictError("the session was given another chunk meanwhile")
        for number, (chunk, parsed) in enumerate(zip(chunks, anew, strict=True)):
            for name, value in parsed.added_to(row if number else None).items():
                setattr(row, name, value)
            key = columns_key(row.id, chunk.sequence)
            if chunk.columns_sha256 != parsed.columns.sha256:
                store.replace(self.session, key, parsed.columns)
                chunk.columns_sha256 = parsed.columns.sha256
            chunk.samples, chunk.reading = len(parsed.telemetry.samples), parsed.reading
        record_event(self.session, self.caller, "session.read_again", row.id, row.satellite_id)

    def close(self, row: TelemetrySession) -> None:
        """Close an open session; its identity is then that of its chunks."""
        if row.state == "closed":
            return
        chunks = self.chunks(row.id)
        if not chunks:
            raise ConflictError("the session has no samples")
        sha256 = identity(chunks)
        if self.find_content(row.satellite_id, row.magnetometer_id, sha256) is not None:
            raise ConflictError("there is a session of the same chunks already")
        row.sha256, row.state, row.closed_at = sha256, "closed", utc_now()
        record_event(self.session, self.caller, "session.close", row.id, row.satellite_id)

    def chunks(self, session_id: str) -> Sequence[Chunk]:
        """Return the chunks of a session in the order of their arrival."""
        return self.session.scalars(select(Chunk).where(Chunk.session_id == session_id).order_by(Chunk.sequence)).all()

    def columns(self, session_id: str, store: Store) -> list[bytes]:
        """Return the columnar form of a session, chunk by chunk; ExpiredError where it has been removed."""
        reached = within_reach(TelemetrySession.satellite_id, self.caller)
        asked = select(TelemetrySession.raw_removed_at, Chunk.sequence, Chunk.columns_sha256).outerjoin(
            Chunk, Chunk.session_id == TelemetrySession.id
        )
        rows = self.session.execute(
            asked.where(TelemetrySession.id == session_id, reached).order_by(Chunk.sequence)
        ).all()
        if not rows:
            raise NotFoundError("no such session")
        if rows[0].raw_removed_at is not None:
            raise ExpiredError(REMOVED)
        kept = [(row.sequence, row.columns_sha256) for row in rows if row.sequence is not None]
        return [store.get(self.session, columns_key(session_id, number), sha256) for number, sha256 in kept]

    def columns_of(self, row: TelemetrySession, chunks: Sequence[Chunk], store: Store) -> list[bytes]:
        """Return what `columns` does, of a session whose ``chunks`` have been asked for already."""
        if row.raw_removed_at is not None:
            raise ExpiredError(REMOVED)
        keys = [(columns_key(row.id, chunk.sequence), chunk.columns_sha256) for chunk in chunks]
        return [store.get(self.session, key, sha256) for key, sha256 in keys]

    def check_day(self, most_bytes: int, declared: int) -> None:
        """Raise QuotaError where ``declared`` further bytes exceed what the caller's key may send in 24 hours."""
        since = utc_now() - DAY
        mine = (TelemetrySession.created_by == self.caller.key_id, Chunk.created_at > since)
        sent = select(func.coalesce(func.sum(Chunk.size_bytes), 0), func.min(Chunk.created_at))
        row = self.session.execute(sent.join(TelemetrySession).where(*mine)).one()
        used, first = int(row[0]), row[1] or utc_now()
        if used + declared > most_bytes:
            reset_s = max(1, int((first - since).total_seconds()) + 1)
            raise QuotaError("bytes of telemetry of this key in 24 hours", most_bytes, used, reset_s=reset_s)

    def count(self) -> int:
        """Return how many sessions the caller reaches."""
        reached = within_reach(TelemetrySession.satellite_id, self.caller)
        return self.session.scalar(select(func.count()).select_from(TelemetrySession).where(reached)) or 0


def samples_of(columns: Sequence[bytes]) -> Samples:
    """Return the samples of chunks, in time order, repeated times flagged."""
    return merge_samples([decode(chunk) for chunk in columns])


def identity(chunks: Sequence[Chunk]) -> str:
    """Return what a session's bytes are known by: their SHA-256, or that of the list of its chunks' SHA-256."""
    if len(chunks) == 1:
        return chunks[0].sha256
    return hashlib.sha256("\n".join(chunk.sha256 for chunk in chunks).encode()).hexdigest()


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
