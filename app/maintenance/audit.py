"""Does the store hold, byte for byte, everything that was acknowledged, and nothing that nobody knows?"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

import zstandard
from sqlalchemy import ColumnElement, select, text, union_all
from sqlalchemy.orm import Session, aliased

from app.access.idempotency import IdempotencyKey
from app.client.receipts import read_receipts
from app.errors import StoredObjectCorruptError
from app.indices.tables import FieldFile, IndexFile
from app.jobs.reprocessing import KIND
from app.jobs.tables import Job
from app.jobs.transitions import UNENDED
from app.maintenance.object_names import KINDS, Naming, naming_of
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.sessions.repository import identity
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database import Database, DatabaseNow
from app.storage.database_store import ObjectToRemove
from app.storage.migration import require_head
from app.storage.store import Store, columns_key, digest, moments_key, raw_key, residuals_key, series_key

CORRUPT: Final = "stored_object_corrupt"
STRANGER: Final = ("unnamed_object", "no row names this object")
LEFT: Final = ("unremoved_object", "every session that names this object is past its retention")
PAST_LEASE: Final = "past_lease"
FLEETING: Final = frozenset({CORRUPT, STRANGER[0], LEFT[0], PAST_LEASE})
"""What a transaction in flight may look like: it is looked at once more when that has ended."""
LOOKS: Final = 3
LONGEST_WAIT_S: Final = 150.0
"""PostgreSQL ends a transaction that says nothing for two minutes; one that is at work longer is not waited for."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as it must be."""

    code: str
    subject: str
    why: str


@dataclass(frozen=True, slots=True)
class Audit:
    """What was looked at, and what was found."""

    sessions: int
    objects: int
    parameter_sets: int
    jobs: int
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the audit as JSON has it."""
        counts = {name: getattr(self, name) for name in ("sessions", "objects", "parameter_sets", "jobs")}
        found = [{"code": one.code, "subject": one.subject, "why": one.why} for one in self.findings]
        return {**counts, "findings": found}


class _Auditor:
    """One pass over rows and objects in one reading transaction."""

    def __init__(self, session: Session, store: Store) -> None:
        self._session = session
        self._store = store
        self.named: set[str] = set()
        self.given_up: set[str] = set()
        self.findings: list[Finding] = []
        self.sessions = self.parameter_sets = self.jobs = 0

    def find(self, code: str, subject: str, why: str) -> None:
        """Note one thing that is not as it must be."""
        self.findings.append(Finding(code, subject, why))

    def object(self, key: str, sha256: str, *, is_removed: bool = False) -> None:
        """Read an object that a row names, once; its digest is verified on the way.

        One that a removed session names may be gone, unless a session that lives names it too.
        """
        if is_removed:
            self.given_up.add(key)
        elif key not in self.named:
            self.named.add(key)
            if (why := broken(self._session, self._store, key, sha256)) is not None:
                self.find(CORRUPT, key, why)

    def telemetry(self) -> None:
        """Look at every session and its chunks."""
        for row in self._session.scalars(select(TelemetrySession).execution_options(yield_per=200)):
            self.sessions += 1
            chunks = self._session.scalars(
                select(Chunk).where(Chunk.session_id == row.id).order_by(Chunk.sequence)
            ).all()
            is_removed = row.raw_removed_at is not None
            for chunk in chunks:
                self.object(raw_key(row.satellite_id, chunk.sha256), chunk.sha256, is_removed=is_removed)
                self.object(columns_key(row.id, chunk.sequence), chunk.columns_sha256, is_removed=is_removed)
            if row.state == "closed" and (not chunks or identity(chunks) != row.sha256):
                self.find("identity", row.id, "the session's digest is not that of its chunks")
            if sum(chunk.samples for chunk in chunks) != row.samples:
                self.find("count", row.id, "the session's samples are not those of its chunks")

    def results(self) -> None:
        """Look at every parameter set: its residuals, its moments, its sessions, its job."""
        for row in self._session.scalars(select(ParameterSet).execution_options(yield_per=200)):
            self.parameter_sets += 1
            self.object(residuals_key(row.id), row.residuals_sha256)
            if row.moments_sha256 is not None:
                self.object(moments_key(row.id), row.moments_sha256)
            link = ParameterSetSession
            inputs = select(link.session_id).where(link.parameter_set_id == row.id)
            if self._session.scalars(inputs).first() is None:
                self.find("no_input", row.id, "the parameter set names no session")
            job = self._session.get(Job, row.job_id)
            if job is None or job.state != "succeeded":
                self.find("no_job", row.id, "the parameter set's job did not succeed")

    def activations(self) -> None:
        """Look at the history of what was in force: each activation follows the one before, and the last one rules."""
        order = (Activation.satellite_id, Activation.magnetometer_id, Activation.begun_at, Activation.id)
        before: Activation | None = None
        rulers: set[str] = set()
        ended: dict[tuple[str, str, datetime], list[Activation]] = {}
        for row in self._session.scalars(select(Activation).order_by(*order)):
            is_first = before is None or _sensor(before) != _sensor(row)
            if is_first:
                ended.clear()
            if not is_first and before is not None and (before.ended_at is None or before.ended_at > row.begun_at):
                self.find("activation", before.id, "the activation goes on beside the one that followed it")
            previous = None if row.previous_id is None else self._session.get(Activation, row.previous_id)
            if previous is not None and previous.parameter_set_id == row.parameter_set_id:
                self.find("activation", row.id, "the parameter set stands as its own predecessor")
            replaced = ended.get((*_sensor(row), row.begun_at), [])
            if replaced and not any(self._follows(row, one) for one in replaced):
                self.find("activation", row.id, "the activation took another's place and does not name it")
            if row.ended_at is not None:
                ended.setdefault((*_sensor(row), row.ended_at), []).append(row)
            if row.ended_at is None:
                rulers.add(row.parameter_set_id)
            before = row
        active = set(self._session.scalars(select(ParameterSet.id).where(ParameterSet.status == "active")))
        for parameter_set_id in sorted(active ^ rulers):
            self.find("activation", parameter_set_id, "its status and its activations do not agree")

    def _follows(self, row: Activation, replaced: Activation) -> bool:
        """Return whether ``row`` replaced it, or is a rollback to what it had replaced."""
        if row.previous_id == replaced.id:
            return True
        back = None if replaced.previous_id is None else self._session.get(Activation, replaced.previous_id)
        return back is not None and (back.parameter_set_id, back.previous_id) == (row.parameter_set_id, row.previous_id)

    def queue(self) -> None:
        """Look at every job: results of those that succeeded, leases of those that run, requests that sum others up."""
        for row in self._session.scalars(select(Job).execution_options(yield_per=500)):
            self.jobs += 1
            if row.state == "succeeded" and row.result is None:
                self.find("no_result", row.id, "the job succeeded without a result")
            series = (row.result or {}).get("series")
            if isinstance(series, dict):
                self.object(series_key(row.id), str(series["sha256"]))
        for job_id in self._session.scalars(select(Job.id).where(is_past_lease())):
            self.find(PAST_LEASE, job_id, "the job's lease ended a minute ago and nobody took it up")
        child = aliased(Job)
        unended = select(child.id).where(child.parent_id == Job.id, child.state.in_(UNENDED))
        waiting = select(Job).where(Job.kind == KIND, Job.state == "running", ~unended.exists())
        for row in self._session.scalars(waiting):
            self.find("unsettled", row.id, "every calibration of the reprocessing has ended, and it has not")

    def keys(self) -> None:
        """Look at every Idempotency-Key: what it made is there."""
        made = union_all(select(TelemetrySession.id), select(Job.id)).subquery()
        lost = select(IdempotencyKey).where(IdempotencyKey.resource_id.not_in(select(made.c.id)))
        for row in self._session.scalars(lost):
            self.find("idempotency_key", row.resource_id, "an Idempotency-Key names what is not there")

    def field_sources(self) -> None:
        """Look at every index file and file of coefficients: are its bytes those of its digest?"""
        for kind in (IndexFile, FieldFile):
            rows = self._session.execute(select(kind.id, kind.sha256, kind.content).execution_options(yield_per=20))
            for file_id, sha256, content in rows:
                try:
                    is_sound = digest(zstandard.decompress(content)) == sha256
                except zstandard.ZstdError:
                    is_sound = False
                if not is_sound:
                    why = "the file does not have its digest"
                    self.findings.append(Finding("stored_object_corrupt", f"{kind.__tablename__}/{file_id}", why))

    def strangers(self) -> int:
        """Look for objects that no row names, or that every row has given up; return how many objects there are."""
        leaving = set(self._session.scalars(select(ObjectToRemove.key)))
        count = 0
        for key in self._store.keys(self._session):
            count += 1
            if key in self.named or key in leaving:
                continue
            code, why = LEFT if key in self.given_up else STRANGER
            self.find(code, key, why)
        return count

    def receipts(self, path: Path) -> None:
        """Look for every file of a station's receipts: its bytes are here, or past their retention."""
        for receipt in read_receipts(path):
            row = self._session.scalar(
                select(TelemetrySession).where(
                    TelemetrySession.satellite_id == receipt.satellite,
                    TelemetrySession.magnetometer_id == receipt.magnetometer,
                    TelemetrySession.sha256 == receipt.sha256,
                )
            )
            if row is None:
                self.find("receipt", receipt.name, f"{path} says it was sent, and no session has its bytes")


def broken(session: Session, store: Store, key: str, sha256: str) -> str | None:
    """Return why the object under ``key`` is not the bytes of ``sha256``, None where it is."""
    try:
        store.get(session, key, sha256)
    except StoredObjectCorruptError as error:
        return str(error)
    return None


def is_past_lease() -> ColumnElement[bool]:
    """Return the condition that tells jobs whose worker was lost a minute ago, and that nobody took up."""
    return (Job.state == "running") & (Job.lease_until < DatabaseNow(-60.0))


def _sensor(row: Activation) -> tuple[str, str]:
    return row.satellite_id, row.magnetometer_id


def audit(database: Database, store: Store, receipts: Sequence[Path] = ()) -> Audit:
    """Return what is amiss between the rows, the objects and their digests, and with the files of ``receipts``.

    Rows are of one moment, objects are not: what looks amiss is looked at again once the transactions that were in
    flight have ended.
    """
    require_head(database)
    with database.read() as session:
        if not database.is_sqlite:  # one snapshot for all of it, as SQLite gives by itself
            session.connection(execution_options={"isolation_level": "REPEATABLE READ"})
        auditor = _Auditor(session, store)
        auditor.telemetry()
        auditor.results()
        auditor.activations()
        auditor.queue()
        auditor.keys()
        auditor.field_sources()
        objects = auditor.strangers()
        for path in receipts:
            auditor.receipts(path)
    findings = _lasting(database, store, auditor.findings)
    return Audit(auditor.sessions, objects, auditor.parameter_sets, auditor.jobs, tuple(findings))


def _lasting(database: Database, store: Store, findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings that are still true when what was in flight has ended."""
    left = list(findings)
    for _ in range(LOOKS):
        if not any(one.code in FLEETING for one in left):
            break
        _let_writers_end(database)
        with database.read() as session:
            left = [one for one in left if one.code not in FLEETING or _is_still_so(session, store, one)]
    return left


def _is_still_so(session: Session, store: Store, finding: Finding) -> bool:
    key = finding.subject
    if finding.code == PAST_LEASE:
        return session.scalar(select(Job.id).where(Job.id == key, is_past_lease())) is not None
    named = naming_of(session, key)
    if finding.code == CORRUPT and key.partition("/")[0] not in KINDS:
        return True  # bytes in a row of their own, which is of the moment that was looked at
    if finding.code == CORRUPT:
        return named.sha256 is not None and broken(session, store, key, named.sha256) is not None
    is_leaving = session.get(ObjectToRemove, key) is not None
    return named.naming is not Naming.NEEDED and not is_leaving and bool(store.has(session, [key]))


def _let_writers_end(database: Database) -> None:
    """Return when every transaction that is open now has ended, or has been at work for too long."""
    if database.is_sqlite:
        with database.write():
            return
    with database.read() as session:
        since = session.scalar(select(DatabaseNow()))
    deadline = time.monotonic() + LONGEST_WAIT_S
    while time.monotonic() < deadline:
        with database.read() as session:
            if session.execute(WRITERS, {"since": since}).first() is None:
                return
        time.sleep(0.1)


WRITERS: Final = text(
    "SELECT 1 FROM pg_stat_activity WHERE datname = current_database() AND application_name = 'magcal' "
    "AND xact_start < :since AND pid <> pg_backend_pid() LIMIT 1"
)


def lines_of(found: Audit) -> Iterator[str]:
    """Yield the audit as lines for a person."""
    for one in found.findings:
        yield f"{one.code}: {one.subject}: {one.why}"
    yield (
        f"{found.sessions} sessions, {found.objects} objects, {found.parameter_sets} parameter sets, "
        f"{found.jobs} jobs: {len(found.findings)} findings"
    )
