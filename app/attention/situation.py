"""What is known of each magnetometer that decides whether it needs attention: a few queries for a whole fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from typing import Any, Final, TypeVar, cast

from sqlalchemy import BindParameter, ColumnElement, Row, Select, and_, bindparam, func, literal_column, select
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased, join, outerjoin

from app.aboard.repository import NotAboard, not_aboard
from app.attention.tables import SetLife
from app.jobs.tables import Job, JobSession
from app.orbits.tables import OrbitRow
from app.outbox.events import EventType
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.tables import SessionMonitoring, TelemetrySession
from app.storage.database import id_before

DATA_STALE_DAYS: Final = 30.0
ORBIT_STALE_DAYS: Final = 7.0
STATION_SILENT_HOURS: Final = 72.0
IDS_AT_ONCE: Final = 500
LATE_MS: Final = 5000
LATE_EVENTS: Final = 20
"""How far back what is committed late is looked for: written so long, or so many rows, before the newest one known."""
MOST_CHANGES: Final = 2000
LOOKED_AT: Final = 100
"""Newest orbits of a satellite among which one of its own is looked for."""
POSITIONED: Final = frozenset({"ref_b", "ref_bx", "ref_eci_x", "x_km"})
"""Columns that make an orbit unnecessary."""

Place = tuple[str, str]
Facts = dict[Place, Any]


@dataclass(frozen=True, slots=True)
class SetFacts:
    """A parameter set: in force, or the newest there is."""

    id: str
    grade: str
    status: str
    method: str
    job_id: str
    data_until: datetime
    created_at: datetime
    begun_at: datetime | None = None
    session_ids: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SessionFacts:
    """The session with the newest data, and what it says of the set in force, where that was asked."""

    id: str
    data_from: datetime | None
    data_until: datetime
    created_at: datetime
    needs_orbit: bool
    is_usable: bool
    judged_set_id: str | None
    grade: str | None
    residual_rms_nt: float | None
    residual_ratio: float | None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class OrbitFacts:
    """The orbit with the newest epoch."""

    id: str
    format: str
    epoch: datetime
    until: datetime | None
    norad_id: str | None
    created_at: datetime
    instead: OwnOrbit | None = None
    """Where it names another object: the newest orbit that names the satellite."""


@dataclass(frozen=True, slots=True)
class OwnOrbit:
    """An orbit of the satellite that names the satellite."""

    id: str
    epoch: datetime
    until: datetime | None


@dataclass(frozen=True, slots=True)
class JobFacts:
    """The newest calibration job."""

    id: str
    state: str
    request: Mapping[str, object]
    error: Mapping[str, object] | None
    created_at: datetime
    finished_at: datetime | None
    session_ids: tuple[str, ...] = ()


Linked = TypeVar("Linked", SetFacts, JobFacts)


@dataclass(frozen=True, slots=True)
class LifeFacts:
    """Until when a set in force is good by the trend of its magnetometer's sets; None where that is not told."""

    parameter_set_id: str
    until: datetime | None
    share: float
    is_capped: bool


@dataclass(frozen=True, slots=True)
class Situation:
    """One magnetometer with what is known of it, and its satellite's limits of age."""

    satellite_id: str
    satellite_name: str | None
    norad_id: str | None
    magnetometer_id: str
    created_at: datetime
    policy: Mapping[str, object] | None
    data_stale_days: float
    orbit_stale_days: float
    station_silent_hours: float
    active: SetFacts | None = None
    newest: SetFacts | None = None
    session: SessionFacts | None = None
    received_at: datetime | None = None
    orbit: OrbitFacts | None = None
    job: JobFacts | None = None
    aboard: NotAboard | None = None
    life: LifeFacts | None = None
    extra: Mapping[str, object] = field(default_factory=dict)

    @property
    def judged(self) -> SessionFacts | None:
        """The session, where it was judged against the set that is in force now."""
        if self.session is None or self.active is None or self.session.judged_set_id != self.active.id:
            return None
        return self.session

    @property
    def is_calibrating(self) -> bool:
        """Whether a calibration waits or runs."""
        return self.job is not None and self.job.state in {"queued", "running"}


def situations(session: Session, satellites: Sequence[str] | None = None) -> list[Situation]:
    """Return the situation of every magnetometer, or of those of ``satellites``, by satellite and magnetometer."""
    of = _Reach(session, satellites)
    active, newest = _active(of), _newest_sets(of)
    last, received, orbits, jobs = _sessions(of), _received(of), _orbits(of), _jobs(of)
    aboard = {(one.satellite_id, one.magnetometer_id): one for one in not_aboard(session, satellites)} if active else {}
    lives, sensors = _lives(of), of.rows(_sensors)
    return [
        Situation(
            satellite_id, name, norad_id, sensor_id, created_at, policy,
            data_days or DATA_STALE_DAYS, orbit_days or ORBIT_STALE_DAYS, silent_hours or STATION_SILENT_HOURS,
            active.get(place), newest.get(place), last.get(place), received.get(place), orbits.get(satellite_id),
            jobs.get(place), aboard.get(place), lives.get(place),
        )
        for satellite_id, name, norad_id, sensor_id, created_at, policy, data_days, orbit_days, silent_hours in sensors
        for place in [(satellite_id, sensor_id)]
    ]  # fmt: skip


class _Reach:
    """The satellites that are asked for, all where there are none named, and how they are asked for."""

    def __init__(self, session: Session, satellites: Sequence[str] | None) -> None:
        self.session = session
        self._named = {} if satellites is None else {NAMED.key: satellites}

    def rows(self, statement: Callable[[bool], Select[*tuple[Any, ...]]]) -> Sequence[Row[*tuple[Any, ...]]]:
        """Return the rows of ``statement``, which is made once for all satellites and once for those that are named."""
        return self.session.execute(statement(bool(self._named)), self._named).all()


ACTIVE: Final[ColumnElement[str]] = literal_column("'active'")
"""Not a parameter: SQLite would not use the index of the sets in force."""
NAMED: Final[BindParameter[Any]] = bindparam("satellites", expanding=True)


def _of(column: InstrumentedAttribute[str], is_part: bool) -> list[ColumnElement[bool]]:
    return [column.in_(NAMED)] if is_part else []


@cache
def _sensors(is_part: bool) -> Select[*tuple[Any, ...]]:
    joined = select(*SENSOR_COLUMNS).join(Satellite, Satellite.id == Magnetometer.satellite_id)
    own = joined.where(*_of(Magnetometer.satellite_id, is_part))
    return own.order_by(Magnetometer.satellite_id, Magnetometer.id)


def _newest(
    table: Any, columns: Sequence[Any], is_part: bool, *conditions: Callable[[Any], ColumnElement[bool]], by: str = "id"
) -> Select[*tuple[Any, ...]]:
    """Return the statement of ``columns`` of each magnetometer's newest row of ``table``: one look into an index each.

    Beside ``table`` itself, columns of what a session says of the set in force are joined where it is the table.
    """
    other = aliased(table)
    own = [other.satellite_id == Magnetometer.satellite_id, other.magnetometer_id == Magnetometer.id]
    first = select(other.id).where(*own, *(condition(other) for condition in conditions))
    order = getattr(other, by)
    found = first.order_by(order.desc(), other.id.desc()).limit(1).correlate(Magnetometer).scalar_subquery()
    joined = join(Magnetometer, table, table.id == found)
    if table is TelemetrySession:
        joined = outerjoin(joined, SessionMonitoring, SessionMonitoring.session_id == table.id)
    chosen = select(Magnetometer.satellite_id, Magnetometer.id, *columns).select_from(joined)
    return chosen.where(*_of(Magnetometer.satellite_id, is_part))


SENSOR_COLUMNS: Final = (
    Satellite.id, Satellite.name, Satellite.norad_id, Magnetometer.id, Magnetometer.created_at, Magnetometer.policy,
    Satellite.data_stale_days, Satellite.orbit_stale_days, Satellite.station_silent_hours,
)  # fmt: skip
"""Not whole rows: making objects of these takes several times as long as reading them."""
SET_COLUMNS: Final = (
    ParameterSet.id, ParameterSet.grade, ParameterSet.status, ParameterSet.method, ParameterSet.job_id,
    ParameterSet.data_until, ParameterSet.created_at,
)  # fmt: skip


@cache
def _active_sets(is_part: bool) -> Select[*tuple[Any, ...]]:
    begun = and_(Activation.parameter_set_id == ParameterSet.id, Activation.ended_at.is_(None))
    return (
        select(ParameterSet.satellite_id, ParameterSet.magnetometer_id, *SET_COLUMNS, Activation.begun_at)
        .outerjoin(Activation, begun)
        .where(ParameterSet.status == ACTIVE, *_of(ParameterSet.satellite_id, is_part))
    )


def _active(of: _Reach) -> Facts:
    return {(row[0], row[1]): SetFacts(*row[2:]) for row in of.rows(_active_sets)}


@cache
def _last_sets(is_part: bool) -> Select[*tuple[Any, ...]]:
    return _newest(ParameterSet, SET_COLUMNS, is_part)


def _newest_sets(of: _Reach) -> Facts:
    rows = of.rows(_last_sets)
    links = _links(of.session, ParameterSetSession.parameter_set_id, ParameterSetSession.session_id,
                   [row[2] for row in rows if row[4] == "candidate"])  # fmt: skip
    return {(row[0], row[1]): _linked(SetFacts(*row[2:]), links) for row in rows}


@cache
def _last_sessions(is_part: bool) -> Select[*tuple[Any, ...]]:
    row_of, said = TelemetrySession, cast(Any, SessionMonitoring.record)
    columns = (
        row_of.id, row_of.data_from, row_of.data_until, row_of.created_at, row_of.columns, row_of.state,
        row_of.raw_removed_at, SessionMonitoring.parameter_set_id, SessionMonitoring.grade,
        SessionMonitoring.residual_rms_nt, SessionMonitoring.residual_ratio, said["reasons"],
    )  # fmt: skip
    return _newest(row_of, columns, is_part, lambda other: other.data_until.is_not(None), by="data_until")


def _sessions(of: _Reach) -> Facts:
    return {(row[0], row[1]): _session_facts(row) for row in of.rows(_last_sessions)}


def _session_facts(row: Sequence[Any]) -> SessionFacts:
    _, _, session_id, begin, end, created, columns, state, removed, set_id, grade, rms_nt, ratio, reasons = row
    is_usable = state == "closed" and removed is None
    needs_orbit = not POSITIONED & set(columns)
    return SessionFacts(
        session_id, begin, end, created, needs_orbit, is_usable, set_id, grade, rms_nt, ratio, tuple(reasons or ())
    )


@cache
def _last_received(is_part: bool) -> Select[*tuple[Any, ...]]:
    return _newest(TelemetrySession, (TelemetrySession.created_at,), is_part)


def _received(of: _Reach) -> dict[Place, datetime]:
    return {(row[0], row[1]): row[2] for row in of.rows(_last_received)}


@cache
def _last_orbits(is_part: bool) -> Select[*tuple[Any, ...]]:
    other, row_of = aliased(OrbitRow), OrbitRow
    first = select(other.id).where(other.satellite_id == Satellite.id, other.withdrawn_at.is_(None))
    newest = first.order_by(other.epoch.desc(), other.id.desc()).limit(1).correlate(Satellite).scalar_subquery()
    columns = (row_of.id, row_of.format, row_of.epoch, row_of.until, row_of.details, row_of.created_at)
    chosen = select(Satellite.id, Satellite.norad_id, *columns).select_from(Satellite)
    return chosen.join(row_of, row_of.id == newest).where(*_of(Satellite.id, is_part))


def _orbits(of: _Reach) -> dict[str, OrbitFacts]:
    found = {}
    for satellite_id, own, orbit_id, form, epoch, until, details, created in of.rows(_last_orbits):
        orbit = OrbitFacts(orbit_id, form, epoch, until, _norad_id(details), created)
        if is_other_object(own, orbit.norad_id):
            orbit = replace(orbit, instead=_own_orbit(of.session, satellite_id, own))
        found[satellite_id] = orbit
    return found


def is_other_object(own: str | None, norad_id: str | None) -> bool:
    """Return whether two catalogue numbers are there and differ; 00900 is 900."""
    return None not in {own, norad_id} and str(own).strip().lstrip("0") != str(norad_id).strip().lstrip("0")


def _own_orbit(session: Session, satellite_id: str, own: str | None) -> OwnOrbit | None:
    """Return the newest orbit in use that names the satellite, None where none of the newest ones does."""
    in_use = (OrbitRow.satellite_id == satellite_id, OrbitRow.withdrawn_at.is_(None))
    columns = (OrbitRow.id, OrbitRow.epoch, OrbitRow.until, OrbitRow.details)
    rows = session.execute(select(*columns).where(*in_use).order_by(OrbitRow.epoch.desc()).limit(LOOKED_AT))
    for orbit_id, epoch, until, details in rows:
        norad_id = _norad_id(details)
        if norad_id is not None and not is_other_object(own, norad_id):
            return OwnOrbit(orbit_id, epoch, until)
    return None


def _norad_id(details: Mapping[str, object]) -> str | None:
    found = details.get("norad_id")
    return None if found is None else str(found).strip() or None


@cache
def _last_jobs(is_part: bool) -> Select[*tuple[Any, ...]]:
    columns = (Job.id, Job.state, Job.request, Job.error, Job.created_at, Job.finished_at)
    return _newest(
        Job, columns, is_part, lambda other: other.kind == "calibration", lambda other: other.state != "cancelled"
    )


def _jobs(of: _Reach) -> Facts:
    rows = of.rows(_last_jobs)
    unended = [row[2] for row in rows if row[3] != "succeeded"]
    links = _links(of.session, JobSession.job_id, JobSession.session_id, unended)
    return {(row[0], row[1]): _linked(JobFacts(*row[2:]), links) for row in rows}


@cache
def _told_lives(is_part: bool) -> Select[*tuple[Any, ...]]:
    row_of = SetLife
    columns = (row_of.parameter_set_id, row_of.until, row_of.share, row_of.is_capped)
    told = select(row_of.satellite_id, row_of.magnetometer_id, *columns)
    return told.where(*_of(row_of.satellite_id, is_part))


def _lives(of: _Reach) -> Facts:
    return {(row[0], row[1]): LifeFacts(*row[2:]) for row in of.rows(_told_lives)}


def _links(
    session: Session, key: InstrumentedAttribute[str], value: InstrumentedAttribute[str], ids: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for part in _parts(ids):
        for one, other in session.execute(select(key, value).where(key.in_(part)).order_by(value)):
            found[one] = (*found.get(one, ()), other)
    return found


def _linked(facts: Linked, links: Mapping[str, tuple[str, ...]]) -> Linked:
    return replace(facts, session_ids=links[facts.id]) if facts.id in links else facts


def _parts(ids: Sequence[str]) -> Iterator[Sequence[str]]:
    return (ids[start : start + IDS_AT_ONCE] for start in range(0, len(ids), IDS_AT_ONCE))


@dataclass(frozen=True, slots=True)
class Change:
    """The ends of the log of events and of the audit trail: another one with every write of the service."""

    event_id: int
    audit_id: str


def newest_change(session: Session) -> Change:
    """Return the ends of the log of events and of the audit trail."""
    from app.access.audit_trail import AuditEvent
    from app.outbox.tables import OutboxEntry

    event_id, audit_id = session.execute(select(
        select(func.max(OutboxEntry.id)).scalar_subquery(), select(func.max(AuditEvent.id)).scalar_subquery()
    )).one()  # fmt: skip
    return Change(event_id or 0, audit_id or "")


def changed_satellites(session: Session, since: Change) -> set[str] | None:
    """Return the satellites of what was written since; None where that is more than is worth telling apart.

    That something needs attention, or no longer does, follows from what is known here and changes none of it.
    Ids count as rows are written, not as they are committed: a little of what was before is looked at again.
    """
    from app.access.audit_trail import AuditEvent
    from app.outbox.tables import OutboxEntry

    earlier = id_before(since.audit_id, LATE_MS)
    told = (str(EventType.ATTENTION_RAISED), str(EventType.ATTENTION_CLEARED))
    of_events = select(OutboxEntry.satellite_id).where(
        OutboxEntry.id > since.event_id - LATE_EVENTS, OutboxEntry.type.not_in(told)
    )
    of_audit = select(AuditEvent.satellite_id).where(AuditEvent.id > earlier)
    found: set[str] = set()
    for statement in (of_events, of_audit):
        rows = session.scalars(statement.limit(MOST_CHANGES + 1)).all()
        if len(rows) > MOST_CHANGES:
            return None
        found |= {one for one in rows if one is not None}
    return found
