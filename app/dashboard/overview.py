"""What is known of satellites at a glance: a few queries for any number of satellites, as far as a key reaches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sqlalchemy import func, select
from sqlalchemy.orm import Session, defer

from app.access.caller import Caller
from app.dashboard.schemas import HistoryQuery, HistoryRow, HistoryShort, OverviewRow, SessionState, SetState
from app.dashboard.set_summaries import Residuals, residuals_of, summaries
from app.http.paging import Part, page_of
from app.http.schemas import Page, utc_text
from app.jobs.tables import Job
from app.parameter_sets.json_listing import listed
from app.parameter_sets.schemas import ParameterSetQuery
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.records.parameter_set import ParameterSetRecord, SetSummary, oldest_orbit_days, parameter_set_record
from app.reporting.figures import InForce, SessionMark
from app.satellites.repository import SatelliteRepository
from app.satellites.tables import Satellite
from app.sessions.repository import SessionRepository
from app.sessions.schemas import SessionQuery
from app.sessions.tables import TelemetrySession
from app.storage.database import utc_now
from magcal_core.options import CalibrationOptions

Place = tuple[str, str]


def overview_rows(session: Session, caller: Caller, satellites: Sequence[Satellite]) -> list[OverviewRow]:
    """Return one row a magnetometer of ``satellites``, which the caller reaches."""
    ids = [row.id for row in satellites]
    sensors = SatelliteRepository(session, caller).magnetometers(ids)
    active = _active_sets(session, ids)
    newest = _newest_sets(session, ids)
    last = _last_sessions(session, ids)
    shown = [row.id for row in (*active.values(), *newest.values())]
    begun, residuals = _activations(session, shown), residuals_of(session, shown)
    waiting = _waiting_jobs(session, ids)
    rows = []
    for satellite in satellites:
        names: list[str | None] = [one.id for one in sensors[satellite.id]]
        for name in names or [None]:
            place = (satellite.id, name or "")
            rows.append(
                OverviewRow(
                    satellite=satellite.id,
                    name=satellite.name,
                    magnetometer=name,
                    active=_set_state(active.get(place), begun, residuals),
                    newest=_set_state(newest.get(place), begun, residuals),
                    last_session=_session_state(last.get(place)),
                    jobs_waiting=waiting.get(satellite.id, 0),
                )
            )
    return rows


def history_rows(
    session: Session, caller: Caller, satellite_id: str, query: HistoryQuery
) -> Page[HistoryRow] | Page[HistoryShort]:
    """Return a part of a satellite's parameter sets in flat numbers."""
    wanted = listed(session.connection(), caller, ParameterSetQuery(satellite=satellite_id, **query.model_dump()))
    ids = [set_id for set_id, _ in wanted.sets]
    sessions = _session_ids(session, ids)
    begun = _activations(session, ids)
    replaced = _replaced(session, begun)
    rows = [
        _history_row(one, sessions[one["id"]], begun.get(one["id"]), replaced.get(one["id"]))
        for one in summaries(session, ids)
    ]
    return page_of(rows, Part(rows, wanted.cursor, wanted.total), query, HistoryShort)


def record_of(row: ParameterSet) -> ParameterSetRecord:
    """Return a parameter set as figures and reports take it, ids included."""
    ids = {
        "id": row.id,
        "satellite": row.satellite_id,
        "magnetometer": row.magnetometer_id,
        "job_id": row.job_id,
        "status": row.status,
        "created_at": utc_text(row.created_at),
    }
    return parameter_set_record(row.record | ids)


def timeline(
    session: Session, caller: Caller, satellite_id: str, magnetometer_id: str | None
) -> tuple[list[SessionMark], list[InForce]]:
    """Return the last sessions of a satellite with their verdicts, and the spans in which a set was in force."""
    wanted = SessionQuery(satellite=satellite_id, magnetometer=magnetometer_id, limit=1000)
    telemetry = SessionRepository(session, caller).page(wanted).rows
    link = ParameterSetSession
    graded = session.execute(
        select(link.session_id, ParameterSet.grade)
        .join(ParameterSet, ParameterSet.id == link.parameter_set_id)
        .where(link.session_id.in_([row.id for row in telemetry]))
        .order_by(ParameterSet.id)
    )
    grades = {row.session_id: row.grade for row in graded}
    marks = [
        SessionMark(row.data_from, row.data_until, row.samples, grades.get(row.id))
        for row in telemetry
        if row.data_from is not None and row.data_until is not None
    ]
    spans = select(Activation, ParameterSet.grade).join(ParameterSet, ParameterSet.id == Activation.parameter_set_id)
    spans = spans.where(Activation.satellite_id == satellite_id).order_by(Activation.begun_at.desc()).limit(1000)
    if magnetometer_id is not None:
        spans = spans.where(Activation.magnetometer_id == magnetometer_id)
    now = utc_now()
    in_force = [
        InForce(row.begun_at, row.ended_at or now, row.parameter_set_id[-8:], grade)
        for row, grade in session.execute(spans)
    ]
    return marks, in_force


def _active_sets(session: Session, ids: Sequence[str]) -> dict[Place, ParameterSet]:
    active = select(ParameterSet).where(ParameterSet.satellite_id.in_(ids), ParameterSet.status == "active")
    found = session.scalars(active.options(defer(ParameterSet.record)))
    return {(row.satellite_id, row.magnetometer_id): row for row in found}


def _newest_sets(session: Session, ids: Sequence[str]) -> dict[Place, ParameterSet]:
    place = (ParameterSet.satellite_id, ParameterSet.magnetometer_id)
    newest = select(func.max(ParameterSet.id)).where(ParameterSet.satellite_id.in_(ids)).group_by(*place)
    wanted = select(ParameterSet).where(ParameterSet.id.in_(newest))
    found = session.scalars(wanted.options(defer(ParameterSet.record)))
    return {(row.satellite_id, row.magnetometer_id): row for row in found}


def _last_sessions(session: Session, ids: Sequence[str]) -> dict[Place, TelemetrySession]:
    row_of = TelemetrySession
    number = func.row_number().over(
        partition_by=(row_of.satellite_id, row_of.magnetometer_id),
        order_by=(row_of.data_until.desc(), row_of.id.desc()),
    )
    ranked = (
        select(row_of.id, number.label("number"))
        .where(row_of.satellite_id.in_(ids), row_of.data_until.is_not(None))
        .subquery()
    )
    found = session.scalars(select(row_of).where(row_of.id.in_(select(ranked.c.id).where(ranked.c.number == 1))))
    return {(row.satellite_id, row.magnetometer_id): row for row in found}


def _activations(session: Session, set_ids: Sequence[str]) -> dict[str, Activation]:
    """Return the last activation of each of ``set_ids`` that has been in force."""
    found = session.scalars(
        select(Activation).where(Activation.parameter_set_id.in_(set_ids)).order_by(Activation.begun_at, Activation.id)
    )
    return {row.parameter_set_id: row for row in found}


def _replaced(session: Session, begun: Mapping[str, Activation]) -> dict[str, str]:
    """Return, for each set now in force, the set that its rollback would bring back."""
    in_force = {row.parameter_set_id: row.previous_id for row in begun.values() if row.ended_at is None}
    before = session.scalars(select(Activation).where(Activation.id.in_([one for one in in_force.values() if one])))
    sets = {row.id: row.parameter_set_id for row in before}
    return {set_id: sets[one] for set_id, one in in_force.items() if one in sets}


def _waiting_jobs(session: Session, ids: Sequence[str]) -> dict[str, int]:
    counted = session.execute(
        select(Job.satellite_id, func.count())
        .where(Job.satellite_id.in_(ids), Job.state.in_(["queued", "running"]))
        .group_by(Job.satellite_id)
    )
    return {str(satellite_id): count for satellite_id, count in counted}


def _set_state(
    row: ParameterSet | None, begun: Mapping[str, Activation], residuals: Mapping[str, Residuals]
) -> SetState | None:
    if row is None:
        return None
    activation = begun.get(row.id)
    rms_nt, cross_validated_rms_nt = residuals[row.id]
    return SetState.model_validate(
        {
            "id": row.id,
            "status": row.status,
            "grade": row.grade,
            "method": row.method,
            "data_from": row.data_from,
            "data_until": row.data_until,
            "created_at": row.created_at,
            "activated_at": None if activation is None else activation.begun_at,
            "rms_nt": rms_nt,
            "cross_validated_rms_nt": cross_validated_rms_nt,
        }
    )


def _session_state(row: TelemetrySession | None) -> SessionState | None:
    return None if row is None else SessionState.model_validate(row, from_attributes=True, extra="ignore")


def _session_ids(session: Session, set_ids: Sequence[str]) -> dict[str, list[str]]:
    link = ParameterSetSession
    found: dict[str, list[str]] = {set_id: [] for set_id in set_ids}
    links = select(link.parameter_set_id, link.session_id).where(link.parameter_set_id.in_(set_ids))
    for set_id, session_id in session.execute(links.order_by(link.session_id)):
        found[set_id].append(session_id)
    return found


def _history_row(
    one: SetSummary, session_ids: list[str], activation: Activation | None, replaced_id: str | None
) -> HistoryRow:
    statistics = one["statistics"]
    values: dict[str, object] = {
        "id": one["id"],
        "magnetometer": one["magnetometer"],
        "status": one["status"],
        "grade": one["verdict"]["grade"],
        "method": one["method"],
        "field_model": one["field_model"],
        "orbit_model": one["orbit_model"],
        "data_from": one["data_from"],
        "data_until": one["data_until"],
        "created_at": one["created_at"],
        "activated_at": None if activation is None else activation.begun_at,
        "replaced_id": replaced_id,
        "session_ids": session_ids,
        "options": _options_in_words(one["provenance"].get("options", {})),
        "samples": statistics["samples"],
        "rms_before_nt": statistics["before"]["rms_nt"],
        "rms_nt": statistics["after"]["rms_nt"],
        "cross_validated_rms_nt": statistics["cross_validated_rms_nt"],
        "orbit_age_days": oldest_orbit_days(one),
    }
    return HistoryRow.model_validate(values | _flat(one))


def _options_in_words(options: Mapping[str, object]) -> str:
    """Return the options beside the method that differ from the defaults: ``robust tukey, regressors temp current``."""
    defaults = CalibrationOptions().to_dict()
    asked = {
        name: value
        for name, value in options.items()
        if name != "method" and value is not None and value != defaults.get(name)
    }
    return ", ".join(
        f"{name} {' '.join(map(str, value)) if isinstance(value, list) else value}" for name, value in asked.items()
    )


def _flat(one: SetSummary) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for suffix, values in (("", one["parameters"]), ("_error", one["standard_errors"])):
        groups = (
            ("bias", "_nt", values["bias_nt"]),
            ("scale", "", values["scale"]),
            ("angle", "_deg", values["nonorthogonality_deg"]),
        )
        for name, unit, numbers in groups:
            found |= {f"{name}_{i + 1}{suffix}{unit}": number for i, number in enumerate(numbers)}
    return found
