"""kill -9 in activation, rollback, rebuild and migration: one state or the other is left, and goes on from there.

Each process is forked from one that has imported magcal, so a trial costs little more than what it does.
"""

from __future__ import annotations

import multiprocessing
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faultsite import SEED, TRIALS
from sqlalchemy import func, select
from upkeep_loops import activate, move_schema, rebuild_all

from app.access.caller import SYSTEM
from app.http.receiving import Upload
from app.jobs.engines.open_engine import open_engine
from app.jobs.tables import Job
from app.maintenance.audit import audit
from app.maintenance.rebuild import rebuild
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import Activation, ParameterSet
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.schemas import UploadQuery
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.migration import current, head, upgrade
from app.storage.open_store import open_store
from app.storage.store import columns_key, digest
from app.uploads.ingest import Asked, Ingest

EACH = 4 * TRIALS
LONGEST_S = 0.25
"""The kill comes so long at the most after the process is at work: within its first few rounds."""


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> Settings:
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres_url")
    return Settings(data_dir=tmp_path, database_url=url, store_url=f"file://{tmp_path}/objects", min_free_mb=0)


@pytest.fixture
def place(settings: Settings) -> Iterator[tuple[Settings, list[str], list[str]]]:
    """A database with three sessions and three candidate sets: its settings, the sets, and the keys of the columns."""
    database, store = Database(settings), open_store(settings)
    upgrade(database, settings)
    with database.write() as session:
        session.add(Satellite(id="a", created_at=utc_now()))
        session.flush()
        session.add(Magnetometer(satellite_id="a", id="m", unit="nT", created_at=utc_now()))
    ingest = Ingest(database, store, open_engine(database, store, settings, 0).queue, settings)
    sessions = [ingest_one(database, ingest, number) for number in range(3)]
    sets = [candidate(database, sessions[0], store) for _ in range(3)]
    yield settings, sets, [columns_key(one, 0) for one in sessions]
    database.close()


def ingest_one(database: Database, ingest: Ingest, number: int) -> str:
    rows = "".join(f"2026-01-0{number + 1}T00:00:{s:02d}Z,2000{number},{s},2,20000\n" for s in range(30))
    content = f"time,bx,by,bz,ref_b\n{rows}".encode()
    upload = Upload(content, digest(content), "text/csv")
    prepared = ingest.prepare(Asked(SYSTEM, "a", UploadQuery(magnetometer="m"), upload, None))
    with database.write() as session:
        return ingest.write(session, [prepared])[0].session.id  # type: ignore[list-item]


def candidate(database: Database, session_id: str, store: object) -> str:
    with database.write() as session:
        job = Job(
            id=new_id(), kind="calibration", state="succeeded", priority=0, satellite_id="a", request={}, progress=1.0,
            attempts=1, lost_attempts=0, cancel_requested=False, created_at=utc_now(), result={},
        )  # fmt: skip
        session.add(job)
        session.flush()
        row = ParameterSet(
            id=new_id(), satellite_id="a", magnetometer_id="m", job_id=job.id, status="candidate", grade="accept",
            method="scalar", data_from=utc_now(), data_until=utc_now(), record={}, created_at=utc_now(),
        )  # fmt: skip
        ParameterSetRepository(session, SYSTEM).add(row, [session_id], {"residuals": b"r"}, store)  # type: ignore[arg-type]
        return row.id


def killed(work: Callable[..., None], settings: Settings, things: list[str], after_s: float) -> None:
    """Return when a process that does ``work`` has been killed ``after_s`` seconds after it was at work."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["app.maintenance.rebuild", "app.parameter_sets.repository", "alembic.command", "psycopg"]
    )
    ours, theirs = context.Pipe()
    process = context.Process(target=work, args=(settings, things, theirs))
    process.start()
    theirs.close()
    assert ours.poll(120)
    ours.recv()
    time.sleep(after_s)
    process.kill()
    process.join(60)
    assert process.exitcode == -9
    ours.close()


def moments() -> Iterator[float]:
    """Yield when to kill, s after the process is at work."""
    drawn = random.Random(SEED)  # noqa: S311  draws moments, guards nothing
    yield from (drawn.uniform(0.0, LONGEST_S) for _ in range(EACH))


def test_a_kill_in_activation_or_rollback_leaves_one_history(place):
    settings, sets, _ = place
    database = Database(settings)
    for after_s in moments():
        killed(activate, settings, sets, after_s)
        assert audit(database, open_store(settings)).findings == (), after_s
    with database.read() as session:
        assert session.scalar(select(func.count()).select_from(Activation)) >= EACH
    database.close()


def test_a_kill_in_rebuild_leaves_what_the_next_one_ends(place):
    settings, _, columns = place
    database, store = Database(settings), open_store(settings)
    for after_s in moments():
        killed(rebuild_all, settings, columns, after_s)
        assert rebuild(database, store, settings).failed == ()
        assert audit(database, store).findings == (), after_s
    database.close()


def test_a_kill_in_migration_leaves_a_schema_that_is_brought_up_to_date(place):
    settings, sets, _ = place
    for after_s in moments():
        killed(move_schema, settings, [], 2 * after_s)
        database = Database(settings)
        upgrade(database, settings)
        assert current(database) == head()
        with database.read() as session:
            assert set(session.scalars(select(ParameterSet.id))) == set(sets)
        assert audit(database, open_store(settings)).findings == (), after_s
        database.close()
