"""The schema: up and down on both databases with rows in it, and equal to what the tables say."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import func, inspect, select

import app.idempotency
import app.jobs.tables
import app.keys.tables
import app.orbits.tables
import app.parameter_sets.tables
import app.sessions.tables
import app.store  # noqa: F401
from app.database import Base, Database
from app.keys.repository import KeyRepository
from app.keys.tables import ApiKey
from app.migrate import current, head, make_first_key, migrate, upgrade
from app.settings import Settings


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


def test_rows_survive_every_step_down_to_the_first_revision_and_up_again(database, settings):
    upgrade(database, settings)
    with database.write() as session:
        KeyRepository(session).create(["read"], ["dekart"])
    migrate(database, "0001")
    upgrade(database, settings)
    with database.read() as session:
        assert session.scalar(select(func.count()).select_from(ApiKey)) == 1


def test_only_an_empty_database_gets_a_first_key(database, settings):
    upgrade(database, settings)
    assert make_first_key(database, settings) is not None
    assert make_first_key(database, settings) is None
