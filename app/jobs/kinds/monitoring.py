"""The kind of job that judges sessions against the parameter set in force; nothing is refitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from pydantic import Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.caller import SYSTEM, Caller
from app.http.schemas import Identifier
from app.jobs.kinds.contract import Admission, Claim, Outcome, WrongKindError
from app.jobs.schemas import JobBody
from app.jobs.tables import JobSession
from app.orbits.repository import OrbitRepository
from app.parameter_sets.repository import ParameterSetRepository
from app.sessions.repository import SessionRepository
from app.storage.store import Store
from magcal_core.errors import MagcalError, OptionError

ORBIT_AGE_DAYS: Final = 14.0


class MonitoringBody(JobBody):
    """Judge sessions of one magnetometer against the parameter set in force."""

    kind: Literal["monitoring"]
    session_ids: list[Identifier] = Field(min_length=1, max_length=100)


@dataclass(frozen=True, slots=True)
class SessionToJudge:
    """One session: its chunks and the orbits near it, or the problem that stands in the way of reading them."""

    session_id: str
    columns: Sequence[bytes] = ()
    orbits: Sequence[str] = ()
    problem: str | None = None


@dataclass(frozen=True, slots=True)
class MonitoringWork:
    """The sessions and the record of the set in force, None where none is."""

    sessions: Sequence[SessionToJudge]
    parameter_set_id: str | None
    record: Mapping[str, object] | None


class MonitoringKind:
    """Judges sessions against the parameter set in force and keeps what they say of it."""

    body: type[JobBody] = MonitoringBody
    function = "app.jobs.kinds.monitoring_child:judge"
    warm = ""

    def admit(self, session: Session, caller: Caller, body: JobBody) -> Admission:
        """Return what ``body`` asks for: sessions that are there, of one magnetometer."""
        if not isinstance(body, MonitoringBody):
            raise WrongKindError("not a monitoring")
        ids = sorted(set(body.session_ids))
        rows = [SessionRepository(session, caller).get(one) for one in ids]
        places = {(row.satellite_id, row.magnetometer_id) for row in rows}
        if len(places) != 1:
            raise OptionError("the sessions are not of one magnetometer")
        satellite_id, magnetometer_id = places.pop()
        return Admission({}, satellite_id, magnetometer_id, ids)

    def check(self, session: Session, admission: Admission) -> None:
        """Nothing makes it fail for certain: what cannot be judged is told with the session."""

    def load(self, session: Session, store: Store, claim: Claim) -> MonitoringWork:
        """Return the sessions of the claimed job and the set that is in force now."""
        chosen = ParameterSetRepository(session, SYSTEM).in_force(str(claim.satellite_id), str(claim.magnetometer_id))
        if chosen is None:
            return MonitoringWork((), None, None)
        links = select(JobSession.session_id).where(JobSession.job_id == claim.job_id).order_by(JobSession.session_id)
        wanted = [_session(session, store, one) for one in session.scalars(links)]
        return MonitoringWork(wanted, chosen.id, chosen.record)

    def keep(self, session: Session, store: Store, claim: Claim, found: Outcome) -> dict[str, object]:
        """Keep what each session says of the set."""
        set_id, judged = found.record["parameter_set_id"], found.record["sessions"]
        if not isinstance(set_id, str) or not isinstance(judged, dict):
            return {"parameter_set_id": None, "grades": {}}
        sessions = SessionRepository(session, SYSTEM)
        for session_id, record in judged.items():
            sessions.judge(session_id, set_id, record)
        return {"parameter_set_id": set_id, "grades": {one: record["grade"] for one, record in judged.items()}}


def _session(session: Session, store: Store, session_id: str) -> SessionToJudge:
    sessions = SessionRepository(session, SYSTEM)
    row = sessions.get(session_id)
    try:
        columns = sessions.columns(session_id, store)
        orbits: list[str] = []
        if row.data_from is not None and row.data_until is not None:
            near = OrbitRepository(session, SYSTEM, row.satellite_id)
            orbits = [one.content for one in near.around(row.data_from, row.data_until, ORBIT_AGE_DAYS)]
    except MagcalError as error:
        return SessionToJudge(session_id, problem=f"{error.code}: {error.message}")
    return SessionToJudge(session_id, columns, orbits)
