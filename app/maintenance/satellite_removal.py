"""A satellite is removed with all it has: its telemetry, orbits, jobs and results; only the audit trail keeps its name.

Which tables have rows of it is read from the tables themselves, so that a new one is not forgotten.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Final

from sqlalchemy import ColumnElement, Table, delete, func, or_, select, update
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.access.idempotency import IdempotencyKey
from app.errors import ConflictError
from app.jobs.tables import Job
from app.jobs.transitions import UNENDED, settle
from app.orbits.tables import OrbitRow
from app.parameter_sets.tables import ParameterSet
from app.satellites.repository import SatelliteRepository
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database import Base
from app.storage.database_store import remove_later
from app.storage.object_locks import take_objects
from app.storage.store import columns_key, moments_key, raw_key, residuals_key, series_key

KEPT: Final = frozenset({"audit_event", "object_to_remove"})
"""Tables whose rows outlive their satellite: what was done, and what is still to be removed."""
UNNAMED: Final = frozenset({"connector_request"})
"""Tables whose rows outlive it without its name: that a source was asked counts all the same."""


@dataclass(frozen=True, slots=True)
class Holdings:
    """What a satellite has."""

    magnetometers: int
    sessions: int
    size_bytes: int
    orbits: int
    parameter_sets: int
    jobs: int
    unended_jobs: int

    def confirmation(self, satellite_id: str) -> str:
        """Return the word that only whoever has seen these holdings can give back."""
        lasting = {name: value for name, value in asdict(self).items() if name not in {"jobs", "unended_jobs"}}
        told = f"{satellite_id} {sorted(lasting.items())}"
        return hashlib.sha256(told.encode()).hexdigest()[:16]


def holdings_of(session: Session, caller: Caller, satellite_id: str) -> Holdings:
    """Return what a satellite has, that the caller reaches."""
    satellites = SatelliteRepository(session, caller)
    satellites.get(satellite_id)
    own = TelemetrySession.satellite_id == satellite_id
    sessions = select(func.count(), func.coalesce(func.sum(TelemetrySession.size_bytes), 0)).where(own)
    count, size_bytes = session.execute(sessions).one()
    return Holdings(
        magnetometers=len(satellites.magnetometers([satellite_id])[satellite_id]),
        sessions=count,
        size_bytes=int(size_bytes),
        orbits=_count(session, OrbitRow.satellite_id == satellite_id),
        parameter_sets=_count(session, ParameterSet.satellite_id == satellite_id),
        jobs=_count(session, Job.satellite_id == satellite_id),
        unended_jobs=_count(session, (Job.satellite_id == satellite_id) & Job.state.in_(UNENDED)),
    )


def _count(session: Session, which: ColumnElement[bool]) -> int:
    return session.scalar(select(func.count()).where(which)) or 0


def remove_satellite(session: Session, caller: Caller, satellite_id: str, confirmation: str) -> Holdings:
    """Return what a satellite had, all of it removed with the transaction; its objects are to be removed after that.

    The attempt that works on one of its jobs finds that it no longer holds it, and keeps nothing.

    Raises
    ------
    ConflictError
        ``confirmation`` is not that of what the satellite has now.
    """
    SatelliteRepository(session, caller).get(satellite_id)
    take_objects(session, satellite_id)
    found = holdings_of(session, caller, satellite_id)
    if confirmation != found.confirmation(satellite_id):
        raise ConflictError("what the satellite has is not what was confirmed: ask again without confirm, and look")
    own_jobs = select(Job.id).where(Job.satellite_id == satellite_id)
    # A worker that ends one of them takes the job first, then what it has found: so does this.
    session.execute(own_jobs.order_by(Job.id).with_for_update()).all()
    parents = set(session.scalars(select(Job.parent_id).where(Job.id.in_(own_jobs), Job.parent_id.is_not(None))))
    remove_later(session, satellite_id, _objects(session, satellite_id))
    own_sessions = select(TelemetrySession.id).where(TelemetrySession.satellite_id == satellite_id)
    made = or_(IdempotencyKey.resource_id.in_(own_jobs), IdempotencyKey.resource_id.in_(own_sessions))
    session.execute(delete(IdempotencyKey).where(made).execution_options(synchronize_session=False))
    for table in reversed(Base.metadata.sorted_tables):
        which = _rows_of(table, satellite_id)
        if which is not None:
            session.execute(
                update(table).where(which).values(satellite_id=None)
                if table.name in UNNAMED
                else delete(table).where(which)
            )
    for parent_id in sorted(str(one) for one in parents):
        settle(session, parent_id)
    record_event(session, caller, "satellite.remove", satellite_id, satellite_id)
    return found


def _rows_of(table: Table, satellite_id: str) -> ColumnElement[bool] | None:
    """Return the condition that tells the rows of a satellite in ``table``, None where it can have none.

    A table without a column for the satellite has its rows by what they cannot do without: a session, a job, a set.
    """
    if table.name in KEPT:
        return None
    if table.name == "satellite":
        return table.c.id == satellite_id
    if "satellite_id" in table.c:
        return table.c.satellite_id == satellite_id
    found: list[ColumnElement[bool]] = []
    for key in table.foreign_keys:
        parent = key.column.table
        which = None if parent is table or key.parent.nullable else _rows_of(parent, satellite_id)
        if which is not None:
            found.append(key.parent.in_(select(key.column).where(which)))
    return or_(*found) if found else None


def _objects(session: Session, satellite_id: str) -> Iterator[str]:
    """Yield the key of every object of a satellite."""
    chunks = select(Chunk.session_id, Chunk.sequence, Chunk.sha256).join(TelemetrySession)
    for row in session.execute(chunks.where(TelemetrySession.satellite_id == satellite_id)):
        yield raw_key(satellite_id, row.sha256)
        yield columns_key(row.session_id, row.sequence)
    for parameter_set_id in session.scalars(select(ParameterSet.id).where(ParameterSet.satellite_id == satellite_id)):
        yield residuals_key(parameter_set_id)
        yield moments_key(parameter_set_id)
    for job_id in session.scalars(select(Job.id).where(Job.satellite_id == satellite_id)):
        yield series_key(job_id)
