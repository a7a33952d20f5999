"""Does the store hold, byte for byte, everything that was acknowledged, and nothing that nobody knows?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.errors import StoredObjectCorruptError
from app.jobs.tables import Job
from app.parameter_sets.tables import ParameterSet, ParameterSetSession
from app.sessions.repository import identity
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database import Database, DatabaseNow
from app.storage.migration import require_head
from app.storage.store import Store, columns_key, moments_key, raw_key, residuals_key, series_key


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
        self.findings: list[Finding] = []
        self.sessions = self.parameter_sets = self.jobs = 0

    def object(self, key: str, sha256: str, *, may_be_gone: bool = False) -> None:
        """Read an object that a row names; its digest is verified on the way."""
        if key in self.named:
            return
        self.named.add(key)
        if may_be_gone:
            return
        try:
            self._store.get(self._session, key, sha256)
        except StoredObjectCorruptError as error:
            self.findings.append(Finding("stored_object_corrupt", key, str(error)))

    def telemetry(self) -> None:
        """Look at every session and its chunks."""
        for row in self._session.scalars(select(TelemetrySession).execution_options(yield_per=200)):
            self.sessions += 1
            chunks = self._session.scalars(
                select(Chunk).where(Chunk.session_id == row.id).order_by(Chunk.sequence)
            ).all()
            is_removed = row.raw_removed_at is not None
            for chunk in chunks:
                self.object(raw_key(row.satellite_id, chunk.sha256), chunk.sha256, may_be_gone=is_removed)
                self.object(columns_key(row.id, chunk.sequence), chunk.columns_sha256, may_be_gone=is_removed)
            if row.state == "closed" and (not chunks or identity(chunks) != row.sha256):
                self.findings.append(Finding("identity", row.id, "the session's digest is not that of its chunks"))
            if sum(chunk.samples for chunk in chunks) != row.samples:
                self.findings.append(Finding("count", row.id, "the session's samples are not those of its chunks"))

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
                self.findings.append(Finding("no_input", row.id, "the parameter set names no session"))
            job = self._session.get(Job, row.job_id)
            if job is None or job.state != "succeeded":
                self.findings.append(Finding("no_job", row.id, "the parameter set's job did not succeed"))

    def queue(self) -> None:
        """Look at every job: results of those that succeeded, leases of those that run."""
        late = DatabaseNow(-60.0)
        for row in self._session.scalars(select(Job).execution_options(yield_per=500)):
            self.jobs += 1
            if row.state == "succeeded" and row.result is None:
                self.findings.append(Finding("no_result", row.id, "the job succeeded without a result"))
            series = (row.result or {}).get("series")
            if isinstance(series, dict):
                self.object(series_key(row.id), str(series["sha256"]))
        for row in self._session.scalars(select(Job).where(Job.state == "running", Job.lease_until < late)):
            self.findings.append(
                Finding("past_lease", row.id, "the job's lease ended a minute ago and nobody took it up")
            )

    def strangers(self) -> int:
        """Look for objects that no row names; return how many objects there are."""
        count = 0
        for key in self._store.keys(self._session):
            count += 1
            if key not in self.named:
                self.findings.append(Finding("unnamed_object", key, "no row names this object"))
        return count


def audit(database: Database, store: Store) -> Audit:
    """Return what is amiss between the rows, the objects and their digests."""
    require_head(database)
    with database.read() as session:
        if not database.is_sqlite:  # one snapshot for all of it, as SQLite gives by itself
            session.connection(execution_options={"isolation_level": "REPEATABLE READ"})
        auditor = _Auditor(session, store)
        auditor.telemetry()
        auditor.results()
        auditor.queue()
        objects = auditor.strangers()
    return Audit(auditor.sessions, objects, auditor.parameter_sets, auditor.jobs, tuple(auditor.findings))


def lines_of(found: Audit) -> Iterator[str]:
    """Yield the audit as lines for a person."""
    for one in found.findings:
        yield f"{one.code}: {one.subject}: {one.why}"
    yield (
        f"{found.sessions} sessions, {found.objects} objects, {found.parameter_sets} parameter sets, "
        f"{found.jobs} jobs: {len(found.findings)} findings"
    )
