"""The schema: up and down on both databases with rows in it, and equal to what the tables say."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import psycopg
import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import JSON, MetaData, delete, insert, inspect, make_url, select, text

import app.aboard.tables
import app.access.idempotency
import app.access.key_tables
import app.attention.tables
import app.connectors.tables
import app.indices.tables
import app.jobs.tables
import app.notes.tables
import app.notifications.tables
import app.orbits.tables
import app.outbox.tables
import app.parameter_sets.tables
import app.sessions.tables
import app.storage.database_store  # noqa: F401
from app.access.caller import SYSTEM
from app.access.first_key import make_first_key
from app.access.key_repository import KeyRepository
from app.http.receiving import Upload
from app.jobs.engines.cluster import ClusterQueue
from app.jobs.engines.embedded import EmbeddedQueue
from app.jobs.execution.leases import claim_one, finish
from app.jobs.repository import JobRepository
from app.jobs.schemas import CalibrationBody, JobQuery
from app.orbits.parsing import parse_message
from app.orbits.repository import OrbitRepository
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.parsed import Parsed
from app.sessions.repository import SessionRepository, Writing
from app.settings import Settings
from app.storage.database import Base, Database, utc_now
from app.storage.migration import alembic_config, current, head, migrate, upgrade
from app.storage.open_store import open_store
from app.storage.store import digest
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import read_telemetry, write_samples

REVISIONS: Final = sorted(
    one.revision for one in ScriptDirectory.from_config(alembic_config()).walk_revisions() if one.revision != head()
)


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> Settings:
    if request.param == "sqlite":
        return Settings(data_dir=tmp_path)
    return Settings(data_dir=tmp_path, database_url=request.getfixturevalue("postgres_url"))


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    opened = Database(settings)
    yield opened
    opened.close()


def test_an_empty_database_becomes_what_the_tables_say(database, settings):
    assert current(database) is None
    upgrade(database, settings)
    assert current(database) == head()
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True, "include_object": _is_ours})
        assert compare_metadata(context, Base.metadata) == []


def _is_ours(_object: object, name: str | None, kind: str, _reflected: bool, _other: object) -> bool:
    return not (name or "").startswith("procrastinate") if kind in {"table", "index"} else True


def test_the_schema_goes_down_to_nothing_and_up_again(database, settings):
    upgrade(database, settings)
    migrate(database, "base")
    left = [name for name in inspect(database.engine).get_table_names() if not name.startswith("procrastinate")]
    assert left in (["alembic_version"], [])
    upgrade(database, settings)
    assert current(database) == head()


def rows_of(database: Database) -> dict[str, list[dict[str, object]]]:
    """Return every row of every table of ours, as the database has it now."""
    with database.engine.connect() as connection:
        return {
            table.name: [dict(row) for row in connection.execute(select(table).order_by(*table.primary_key)).mappings()]
            for table in tables_of(database).sorted_tables
        }


def tables_of(database: Database) -> MetaData:
    """Return our tables as the database has them now."""
    there = MetaData()
    there.reflect(database.engine, only=lambda name, _: name in Base.metadata.tables)
    for table in there.sorted_tables:
        for column in table.columns:
            if isinstance(column.type, JSON):
                column.type.none_as_null = True
    return there


def fill(database: Database, settings: Settings) -> None:
    """Keep something of every kind, with jobs that wait and one that has ended."""
    store = open_store(settings)
    telemetry = read_telemetry(write_samples(simulated(SESSIONS[0], 50).samples, "csv"))
    upload = Upload(b"raw bytes", digest(b"raw bytes"), "text/csv")
    with database.write() as session:
        KeyRepository(session).create(["read"], ["dekart"])
        session.add(Satellite(id="dekart", created_at=utc_now()))
        session.flush()
        session.add(Magnetometer(satellite_id="dekart", id="m", unit="nT", created_at=utc_now()))
        session.flush()
        OrbitRepository(session, SYSTEM, "dekart").add(parse_message(tle_text().encode(), "text/plain"))
        sessions, writing = SessionRepository(session, SYSTEM), Writing()
        row, _ = sessions.create("dekart", "m", Parsed.of(upload, telemetry, "csv", store), writing, is_open=False)
        writing.write(session, store)
        queue = EmbeddedQueue() if database.is_sqlite else ClusterQueue(database)
        body = CalibrationBody(kind="calibration", session_ids=[row.id])
        jobs = [JobRepository(session, SYSTEM).submit(body, queue) for _ in range(3)]
        session.flush()
        jobs[0].state, jobs[0].result = "succeeded", {"parameter_set_id": "1" * 32}
        found = ParameterSet(
            id="1" * 32, satellite_id="dekart", magnetometer_id="m", job_id=jobs[0].id, status="candidate",
            grade="weak", method="scalar", data_from=row.data_from, data_until=row.data_until, record={"a": 1.5},
            created_at=utc_now(),
        )  # fmt: skip
        blobs = {"residuals": b"residuals", "moments": b"moments"}
        ParameterSetRepository(session, SYSTEM).add(found, [row.id], blobs, store)


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[bool, Settings]]:
    """Databases of the newest schema with something of every kind, by whether they are SQLite's."""
    made: dict[bool, Settings] = {}
    yield made
    for settings in made.values():
        if settings.database_url is not None:
            with psycopg.connect(server_of(settings), autocommit=True) as connection:
                connection.execute(f"DROP DATABASE {name_of(settings)} WITH (FORCE)".encode())


@pytest.fixture
def filled(settings, made_once, tmp_path_factory) -> Iterator[Database]:
    """A copy of one that was filled once."""
    is_sqlite = settings.database_url is None
    if is_sqlite not in made_once:
        url = None if is_sqlite else settings.database_url
        if url is not None:
            with psycopg.connect(server_of(settings), autocommit=True) as connection:
                connection.execute(b"CREATE DATABASE filled_for_migrations")
            url = make_url(url).set(database="filled_for_migrations").render_as_string(hide_password=False)
        origin = Settings(data_dir=tmp_path_factory.mktemp("filled"), database_url=url)
        opened = Database(origin)
        upgrade(opened, origin)
        fill(opened, origin)
        opened.close()
        made_once[is_sqlite] = origin
    origin = made_once[is_sqlite]
    if is_sqlite:
        shutil.copytree(origin.data_dir, settings.data_dir, dirs_exist_ok=True)
    else:
        with psycopg.connect(server_of(settings), autocommit=True) as connection:
            connection.execute(f"DROP DATABASE {name_of(settings)}".encode())
            connection.execute(f"CREATE DATABASE {name_of(settings)} TEMPLATE {name_of(origin)}".encode())
    opened = Database(settings)
    yield opened
    opened.close()


def name_of(settings: Settings) -> str:
    return str(make_url(str(settings.database_url)).database)


def server_of(settings: Settings) -> str:
    """Return the address of PostgreSQL's own database beside the settings' one."""
    server = make_url(str(settings.database_url)).set(drivername="postgresql", database="postgres")
    return server.render_as_string(hide_password=False)


@pytest.mark.parametrize("revision", REVISIONS)
def test_real_rows_survive_the_way_down_to_any_revision_and_up_again(filled, settings, revision):
    """F22: what a revision knows is there, to the value, when the way has led through it; jobs keep their order."""
    database = filled
    before = rows_of(database)
    assert all(before[name] for name in ("satellite", "magnetometer", "orbit", "session", "chunk", "blob_part", "job"))
    assert [one["moments_sha256"] for one in before["parameter_set"]] == [digest(b"moments")]
    migrate(database, revision)
    there = rows_of(database)
    for name, rows in there.items():
        assert (
            rows == [{column: one[column] for column in rows[0]} for one in before[name]] if rows else not before[name]
        )
    upgrade(database, settings)
    after = rows_of(database)
    made_anew = {"rank"} | ({"queue_id"} if revision < "0002" else set())  # procrastinate's tables come back empty
    made_anew |= {"request_version"} if revision < "0015" else set()  # what was waiting is taken as of the first
    assert sorted(one["rank"] for one in after["job"] if one["state"] == "queued") in ([0, 1], [1, 2])
    for name, rows in after.items():
        if name not in there:
            continue  # a table of a later revision comes back empty
        for old, new in zip(before[name], rows, strict=True):
            assert {k: v for k, v in new.items() if k not in made_anew} == {
                k: v for k, v in old.items() if k not in made_anew
            }, name


@pytest.mark.parametrize("revision", REVISIONS)
def test_what_a_revision_wrote_and_read_goes_on_under_the_next(database, settings, revision):
    """F22: old code with the new schema. No column goes or changes its kind, and new ones may be left out of a row."""
    upgrade(database, settings)
    newest = columns_of(database)
    migrate(database, revision)
    for name, columns in columns_of(database).items():
        for column, kind in columns.items():
            assert newest[name][column]["kind"] == kind["kind"], (name, column)
        for column in set(newest[name]) - set(columns):
            assert newest[name][column]["may_be_left_out"], (name, column)


@pytest.mark.parametrize("revision", REVISIONS)
def test_rows_that_a_revision_writes_into_the_newest_schema_are_read_by_both(filled, settings, revision):
    """F22: the tables as that revision knew them, over the newest schema; its jobs are taken up by today's workers."""
    database = filled
    migrate(database, revision)
    theirs, rows = tables_of(database), rows_of(database)
    upgrade(database, settings)
    with database.write() as session:
        for table in reversed(Base.metadata.sorted_tables):
            session.execute(delete(table))
    with database.write() as session:
        for table in theirs.sorted_tables:
            if rows[table.name]:
                session.execute(insert(table), rows[table.name])
    with database.read() as session:
        for table in theirs.sorted_tables:
            found = session.execute(select(table).order_by(*table.primary_key)).mappings()
            assert [dict(one) for one in found] == rows[table.name], table.name
        waiting = [job.id for job in JobRepository(session, SYSTEM).page(JobQuery(state="queued"))[0]]
        store = open_store(settings)
        assert all(store.get(session, one["key"], one["sha256"]) for one in rows["blob"])
    assert sorted(waiting) == sorted(one["id"] for one in rows["job"] if one["state"] == "queued")
    with database.write() as session:
        claim = claim_one(session, waiting[0], "worker", 10.0, 3)
        assert claim is not None
        finish(session, claim, "succeeded", result={})


def test_marks_of_pulls_are_tied_to_their_satellites_and_those_of_removed_ones_go(database, settings):
    upgrade(database, settings)
    fill(database, settings)
    migrate(database, "0014_set_life")
    marks = ("yamcs/dekart/m/0123", "hapi/gone/m/4567", "orbits-of-the-past/space-track/dekart/1", "index gfz-kp a")
    mark = "INSERT INTO connector_mark (name, mark, updated_at) VALUES (:name, 'x', :now)"
    asked = "INSERT INTO connector_request (id, source, satellite_id, asked_at) VALUES ('1', 'url', 'dekart', :now)"
    with database.write() as session:
        for name in marks:
            session.execute(text(mark), {"name": name, "now": utc_now()})
        session.execute(text("UPDATE satellite SET norad_id = '0046494'"))
        session.execute(text(asked), {"now": utc_now()})
    upgrade(database, settings)
    rows = rows_of(database)
    assert {one["name"]: one["satellite_id"] for one in rows["connector_mark"]} == {
        marks[0]: "dekart", marks[2]: "dekart", marks[3]: None,
    }  # fmt: skip
    assert [(one["satellite_id"], one["catalogue_number"]) for one in rows["connector_request"]] == [
        ("dekart", "46494")
    ]


def columns_of(database: Database) -> dict[str, dict[str, dict[str, object]]]:
    """Return of every column of ours its kind, and whether a row may leave it out."""
    seen = inspect(database.engine)
    ours = {table.name for table in Base.metadata.sorted_tables} & set(seen.get_table_names())
    return {
        name: {
            column["name"]: {
                "kind": str(column["type"]),
                "may_be_left_out": column["nullable"] or column["default"] is not None,
            }
            for column in seen.get_columns(name)
        }
        for name in ours
    }


def test_a_process_of_the_version_before_starts_and_works_over_a_newer_schema(new_service, request, tmp_path):
    """F22: a later version has added a column, a table and an index, under a revision that this one does not know."""
    for url in (None, request.getfixturevalue("postgres_url")):
        settings = Settings(data_dir=tmp_path / str(url is None), database_url=url)
        opened = Database(settings)
        upgrade(opened, settings)
        with opened.write() as session:
            for later in (
                "ALTER TABLE session ADD COLUMN later INTEGER",
                "ALTER TABLE job ADD COLUMN later INTEGER NOT NULL DEFAULT 0",
                "CREATE TABLE later (id INTEGER PRIMARY KEY)",
                "CREATE INDEX ix_job_later ON job (later)",
                "UPDATE alembic_version SET version_num = '9999'",
            ):
                session.execute(text(later))
        opened.close()
        service = new_service(data_dir=settings.data_dir, database_url=url)
        with service.client() as api:
            api.post("/satellites", json={"id": "a"}).raise_for_status()
            api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
            content = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"
            where = {"params": {"magnetometer": "m"}, "headers": {"content-type": "text/csv"}}
            sent = api.post("/satellites/a/sessions", content=content, **where)
            assert sent.status_code == 201
            body = {"kind": "calibration", "session_ids": [sent.json()["id"]]}
            assert api.post("/jobs", json=body).status_code == 202
            assert api.get("/sessions").json()["items"][0]["id"] == sent.json()["id"]


def test_only_an_empty_database_gets_a_first_key(database, settings):
    upgrade(database, settings)
    assert make_first_key(database, settings) is not None
    assert make_first_key(database, settings) is None
