"""The answers of the API that a page asks for first, brought along inside it: its numbers need no further request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from app.access import key_endpoints as keys
from app.access.caller import Caller, Scope
from app.access.key_schemas import KeyQuery
from app.attention import endpoints as attention
from app.attention.entries import Fleet
from app.attention.repository import AttentionRepository
from app.attention.schemas import AttentionCounts, AttentionQuery, FleetQuery
from app.dashboard import endpoints as displays
from app.dashboard.schemas import OverviewQuery
from app.jobs import endpoints as jobs
from app.jobs.schemas import JobQuery
from app.outbox.log import newest_position
from app.parameter_sets.json_listing import Texts, found
from app.satellites import endpoints as satellites
from app.sessions import endpoints as sessions
from app.storage.database import Database
from magcal_core.errors import MagcalError

Answers = Mapping[str, str]
"""Path below /api/v1, as the page's script asks for it -> the answer in JSON."""
Bringer = Callable[[Caller, Database, Texts], Answers]
MOST: Final = 1000
MOST_JOBS: Final = 50
MOST_LINES: Final = 100
MOST_ROWS: Final = 50


def brought(ask: Bringer | None, caller: Caller, database: Database, texts: Texts) -> Answers:
    """Return what ``ask`` brings; nothing where it fails, for the page then asks by itself and shows what is wrong."""
    if ask is None or not caller.may(Scope.READ):
        return {}
    try:
        return ask(caller, database, texts)
    except MagcalError:
        return {}


def newest_event(database: Database) -> int:
    """Return the position in the log of events behind which a page's stream begins."""
    with database.read() as session:
        return newest_position(session)


def of_overview(fleet: Fleet) -> Bringer:
    """Return what brings what needs attention, and the fleet."""

    def ask(caller: Caller, database: Database, _texts: Texts) -> Answers:
        entries = attention.attention_now(AttentionQuery(limit=MOST_LINES, total=True), caller, database, fleet)
        rows = attention.fleet_now(FleetQuery(limit=MOST_ROWS), caller, database, fleet)
        first = rows.model_copy(update={"items": rows.items[:1], "next": "1" if len(rows.items) > 1 else None})
        return {
            f"/attention?limit={MOST_LINES}&total=true": entries.model_dump_json(),
            f"/fleet?limit={MOST_ROWS}&sort=worst": rows.model_dump_json(),
            "/fleet?limit=1": first.model_dump_json(),
        }

    return ask


def counts_of(fleet: Fleet, caller: Caller, database: Database) -> AttentionCounts | None:
    """Return how much needs attention, for the header; None for a key that may not read."""
    if not caller.may(Scope.READ):
        return None
    with database.read() as session:
        return AttentionRepository(session, caller, fleet).counts()


def of_satellite(satellite_id: str) -> Bringer:
    """Return what brings a satellite and its state."""

    def ask(caller: Caller, database: Database, _texts: Texts) -> Answers:
        satellite = satellites.get_satellite(satellite_id, caller, database)
        state = displays.overview_now(OverviewQuery(satellite=satellite_id), caller, database)
        return {
            f"/satellites/{satellite_id}": satellite.model_dump_json(),
            f"/overview?satellite={satellite_id}": state.model_dump_json(),
        }

    return ask


def of_magnetometer(satellite_id: str, magnetometer_id: str) -> Bringer:
    """Return what brings a magnetometer and the state of its satellite."""

    def ask(caller: Caller, database: Database, _texts: Texts) -> Answers:
        magnetometer = satellites.get_magnetometer(satellite_id, magnetometer_id, caller, database)
        state = displays.overview_now(OverviewQuery(satellite=satellite_id), caller, database)
        return {
            f"/satellites/{satellite_id}/magnetometers/{magnetometer_id}": magnetometer.model_dump_json(),
            f"/overview?satellite={satellite_id}": state.model_dump_json(),
        }

    return ask


def of_session(session_id: str) -> Bringer:
    """Return what brings a session and the newest calibration of it, which says why it failed where it did."""

    def ask(caller: Caller, database: Database, _texts: Texts) -> Answers:
        session = sessions.get_session(session_id, caller, database)
        newest = jobs.jobs_now(JobQuery(kind="calibration", limit=1, session=session_id), caller, database)
        return {
            f"/sessions/{session_id}": session.model_dump_json(),
            f"/jobs?kind=calibration&limit=1&session={session_id}": newest.model_dump_json(),
        }

    return ask


def of_parameter_sets(*set_ids: str) -> Bringer:
    """Return what brings parameter sets."""

    def ask(caller: Caller, database: Database, texts: Texts) -> Answers:
        with database.engine.connect() as connection:
            wanted = [one for set_id in set_ids for one in found(connection, caller, set_id).sets]
            read = texts.of(connection, wanted)
        return {f"/parameter-sets/{one}": text.decode() for (one, _), text in zip(wanted, read, strict=True)}

    return ask


def of_jobs(caller: Caller, database: Database, _texts: Texts) -> Answers:
    """Return the newest jobs."""
    newest = jobs.jobs_now(JobQuery(limit=MOST_JOBS, total=True), caller, database)
    return {f"/jobs?limit={MOST_JOBS}&sort=-created&total=true": newest.model_dump_json()}


def of_reprocessings(caller: Caller, database: Database, _texts: Texts) -> Answers:
    """Return the newest reprocessings."""
    newest = jobs.jobs_now(JobQuery(kind="reprocessing", limit=MOST_JOBS, total=True), caller, database)
    return {f"/jobs?kind=reprocessing&limit={MOST_JOBS}&sort=-created&total=true": newest.model_dump_json()}


def of_job(job_id: str) -> Bringer:
    """Return what brings a job."""

    def ask(caller: Caller, database: Database, _texts: Texts) -> Answers:
        return {f"/jobs/{job_id}": jobs.get_job(job_id, caller, database).model_dump_json()}

    return ask


def of_keys(caller: Caller, database: Database, _texts: Texts) -> Answers:
    """Return the keys."""
    if not caller.may(Scope.ADMIN):
        return {}
    return {f"/keys?limit={MOST}": keys.keys_now(KeyQuery(limit=MOST), caller, database).model_dump_json()}
