"""The kind of job that calibrates: sessions and orbits in, a parameter set out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.caller import SYSTEM, Caller
from app.errors import ConflictError, ExpiredError
from app.http.schemas import core_times, parse_utc
from app.indices.repository import FIELD_FILE, IndexRepository, check_field
from app.jobs.kinds.contract import Admission, Claim, Outcome, WrongKindError
from app.jobs.schemas import CalibrationBody, JobBody
from app.jobs.tables import JobSession
from app.orbits.nearest import chosen
from app.orbits.objects import difference
from app.orbits.repository import OrbitRepository
from app.orbits.tables import OrbitRow
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from app.records.calibration_options import as_asked, as_options
from app.satellites.reading import options_of
from app.satellites.repository import SatelliteRepository
from app.sessions.repository import SessionRepository, identity
from app.sessions.tables import Chunk, TelemetrySession
from app.storage.database import new_id, utc_now
from app.storage.store import Store
from magcal_core.errors import OptionError, OrbitMissingError, TleEpochError
from magcal_core.options import CalibrationOptions
from magcal_core.telemetry.time_guesses import on_distance, spans_of

POSITIONED: Final = frozenset({"ref_b", "ref_bx", "ref_eci_x", "x_km"})
"""Columns that make an orbit unnecessary."""
DEFAULT_AGE_DAYS: Final = 14.0
CANDIDATES: Final = "candidate_orbits"
"""Where a request names orbits that a diagnosis tries; without it, all near ones of the satellite are."""


@dataclass(frozen=True, slots=True)
class CalibrationWork:
    """What a calibration works on.

    Each session's chunks, orbits as (id, content), options, its inputs' names; the parameter set that was in force
    before, where there is one; ``strangers`` says of orbits of another object, by id, which; the intervals of indices
    near the data, and name and content of a file of coefficients.
    """

    columns: Sequence[Sequence[bytes]]
    orbits: Sequence[tuple[str, str]]
    options: Mapping[str, object]
    inputs: Sequence[Mapping[str, object]]
    active: Mapping[str, object] | None = None
    strangers: Mapping[str, str] = field(default_factory=dict)
    intervals: Sequence[bytes] = ()
    field_file: tuple[str | None, bytes] | None = None
    candidates: Sequence[str] = ()


class CalibrationKind:
    """Calibrates one magnetometer from one or more of its sessions."""

    body: type[JobBody] = CalibrationBody
    function = "app.jobs.kinds.calibration_child:calibrate"
    warm = "app.jobs.kinds.calibration_child:warm"

    def admit(self, session: Session, caller: Caller, body: JobBody) -> Admission:
        """Return what ``body`` asks for: its sessions must be there, of one magnetometer, and its options sound."""
        if not isinstance(body, CalibrationBody):
            raise WrongKindError("not a calibration")
        session_ids = sorted(set(body.session_ids))
        rows = [SessionRepository(session, caller).get(one) for one in session_ids]
        places = {(row.satellite_id, row.magnetometer_id) for row in rows}
        if len(places) != 1:
            raise OptionError("the sessions are not of one magnetometer")
        _require_telemetry(rows)
        if not all(row.samples for row in rows):
            raise ConflictError("a session has no samples yet")
        satellite_id, magnetometer_id = places.pop()
        magnetometer = SatelliteRepository(session, caller).magnetometer(satellite_id, magnetometer_id)
        options = as_asked(CalibrationOptions.from_dict(options_of(magnetometer) | body.options))
        lock = f"{satellite_id}/{magnetometer_id}"
        if body.field_file is not None:
            options[FIELD_FILE] = body.field_file
        if body.candidate_orbits is not None:
            # Each must be there, and in the caller's reach.
            orbits = OrbitRepository(session, caller, satellite_id)
            options[CANDIDATES] = [orbits.get(one).id for one in dict.fromkeys(body.candidate_orbits)]
        return Admission(options, satellite_id, magnetometer_id, session_ids, lock)

    def check(self, session: Session, admission: Admission) -> None:
        """Raise where telemetry has been removed, or an orbit, index or file is needed and none may serve."""
        check_field(session, admission.request)
        _require_telemetry([session.get_one(TelemetrySession, one) for one in admission.session_ids])
        most_days = limit_days(admission.request)
        orbits = OrbitRepository(session, SYSTEM, str(admission.satellite_id))
        for session_id in admission.session_ids:
            row = session.get_one(TelemetrySession, session_id)
            if POSITIONED & set(row.columns) or row.data_from is None or row.data_until is None:
                continue
            best = chosen(orbits.around(row.data_from, row.data_until, 0.0), row.data_from)
            if best is None:
                raise OrbitMissingError("the telemetry has no reference and no position, and the satellite no orbit")
            try:
                _check_age(best, row.data_from, row.data_until, most_days)
            except TleEpochError as error:
                other_form = on_distance(core_times([row.data_from])[0], spans_of(orbits.instants()))
                raise TleEpochError(error.message + other_form) from error

    def load(self, session: Session, store: Store, claim: Claim) -> CalibrationWork:
        """Return the chunks, the orbits near them and the options of the claimed job."""
        sessions = SessionRepository(session, SYSTEM)
        links = select(TelemetrySession).join(JobSession, JobSession.session_id == TelemetrySession.id)
        rows = session.scalars(links.where(JobSession.job_id == claim.job_id).order_by(TelemetrySession.id)).all()
        chunks = [sessions.chunks(row.id) for row in rows]
        columns = [sessions.columns_of(row, own, store) for row, own in zip(rows, chunks, strict=True)]
        begin = min(row.data_from for row in rows if row.data_from is not None)
        end = max(row.data_until for row in rows if row.data_until is not None)
        # Held from here on, so that whoever asks for it again finds it without the database.
        satellite = SatelliteRepository(session, SYSTEM).get(str(claim.satellite_id))
        orbits = OrbitRepository(session, SYSTEM, satellite.id)
        near = orbits.around(begin, end, limit_days(claim.request))
        others = {row.id: other for row in near if (other := difference(satellite, row.details)) is not None}
        options = as_options(claim.request)
        file_id = options.pop(FIELD_FILE, None)
        options.pop(CANDIDATES, None)
        files = IndexRepository(session, SYSTEM)
        return CalibrationWork(
            columns=columns,
            orbits=[(row.id, row.content) for row in near],
            options=options,
            candidates=[orbits.get(one).content for one in _candidates(claim.request)],
            inputs=[_input(row.id, own) for row, own in zip(rows, chunks, strict=True)],
            active=_in_force(session, claim, begin),
            strangers=others,
            intervals=files.intervals_near(begin, end),
            field_file=None if file_id is None else files.field_file_content(str(file_id)),
        )

    def keep(self, session: Session, store: Store, claim: Claim, found: Outcome) -> dict[str, object]:
        """Keep the parameter set that was found."""
        record = found.record
        links = select(JobSession.session_id).where(JobSession.job_id == claim.job_id)
        verdict = record["verdict"]
        row = ParameterSet(
            id=new_id(),
            satellite_id=claim.satellite_id,
            magnetometer_id=claim.magnetometer_id,
            job_id=claim.job_id,
            status="candidate",
            grade=verdict["grade"] if isinstance(verdict, dict) else "refuse",
            method=record["method"],
            data_from=parse_utc(record["data_from"]),
            data_until=parse_utc(record["data_until"]),
            record=record,
            created_at=utc_now(),
        )
        sets = ParameterSetRepository(session, SYSTEM)
        sets.add(row, list(session.scalars(links)), found.blobs, store)
        return {"parameter_set_id": row.id}


def _input(session_id: str, chunks: Sequence[Chunk]) -> dict[str, object]:
    """Return what a parameter set says of a session that it was found from: its bytes, and how they were read."""
    known: dict[str, object] = {"session_id": session_id, "sha256": identity(chunks)}
    return known if chunks[0].reading is None else known | {"reading": chunks[0].reading}


def _in_force(session: Session, claim: Claim, begin: datetime) -> dict[str, object] | None:
    """Return the record of the set in force, with its id, where its data are older than those that begin at ``begin``.

    A session from before it says what the sensor was, not whether it still is what the set in force says.
    """
    found = ParameterSetRepository(session, SYSTEM).in_force(str(claim.satellite_id), str(claim.magnetometer_id))
    return None if found is None or found.data_from >= begin else {**found.record, "id": found.id}


def _candidates(request: Mapping[str, object]) -> list[str]:
    named = request.get(CANDIDATES)
    return [str(one) for one in named] if isinstance(named, list) else []


def _require_telemetry(rows: Sequence[TelemetrySession]) -> None:
    if any(row.raw_removed_at is not None for row in rows):
        raise ExpiredError("the telemetry of a session is past its satellite's retention and has been removed")


def limit_days(options: Mapping[str, object]) -> float:
    """Return how far an orbit may be from the data, days."""
    limit = options.get("max_orbit_age_days")
    return float(limit) if isinstance(limit, int | float) else DEFAULT_AGE_DAYS


def _check_age(row: OrbitRow, begin: datetime, end: datetime, most_days: float) -> None:
    if row.until is not None and row.epoch <= end and row.until >= begin:
        return
    age = max(begin - row.epoch, row.epoch - end, timedelta(0)) / timedelta(days=1)
    if age > most_days:
        raise TleEpochError(f"the orbit's epoch is {age:.1f} d from the telemetry; limit {most_days:g} d")
