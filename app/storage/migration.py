"""Bring a database to this version's schema; several processes may try at once, one does it."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import structlog
from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, text

import migrations
from app.errors import ConflictError
from app.settings import Settings
from app.storage.database import WRITES, Database

log = structlog.get_logger()
LOCK: Final = 0x6D616763616C  # "magcal", for pg_advisory_lock


def alembic_config(connection: Connection | None = None) -> Config:
    """Return Alembic's configuration over ``connection``."""
    config = Config()
    config.set_main_option("script_location", str(Path(migrations.__file__).parent).replace("%", "%%"))
    config.attributes["connection"] = connection
    return config


def head() -> str:
    """Return the revision that this version of magcal needs."""
    return ScriptDirectory.from_config(alembic_config()).get_current_head() or ""


def current(database: Database) -> str | None:
    """Return the revision of the database, None where it is empty."""
    with database.engine.connect() as connection:
        return MigrationContext.configure(connection).get_current_revision()


def require_head(database: Database) -> None:
    """Refuse a database whose schema is not this version's.

    Raises
    ------
    ConflictError
        The schema is another version's.
    """
    found = current(database)
    if found != head():
        raise ConflictError(f"the schema is {found or 'empty'}, this version needs {head()}: run magcal db upgrade")


@contextmanager
def _alone(database: Database, settings: Settings) -> Iterator[None]:
    """Hold the lock that lets one process alone set a database up."""
    if not database.is_sqlite:
        with database.engine.connect() as connection:
            connection.execute(text("SELECT pg_advisory_lock(:lock)"), {"lock": LOCK})
            connection.commit()
            try:
                yield
            finally:
                connection.execute(text("SELECT pg_advisory_unlock(:lock)"), {"lock": LOCK})
                connection.commit()
        return
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    with (settings.data_dir / ".setup.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def upgrade(database: Database, settings: Settings) -> None:
    """Bring the database to this version's schema, or leave it where a later version of magcal has brought it.

    Migrations only add, so that processes of the version before go on, and may start, while one is rolled out.
    """
    with _alone(database, settings):
        found = current(database)
        if found == head():
            return
        if found is not None and found not in _known():
            log.warning("schema_is_newer", revision=found, known=head())
            return
        migrate(database, "head")


def _known() -> set[str]:
    return {one.revision for one in ScriptDirectory.from_config(alembic_config()).walk_revisions()}


def migrate(database: Database, revision: str) -> None:
    """Move the database up or down to ``revision``."""
    engine = database.engine.execution_options(**{WRITES: True})
    with engine.connect() as connection, _loose(connection), connection.begin():
        config = alembic_config(connection)
        known = MigrationContext.configure(connection).get_current_revision()
        script = ScriptDirectory.from_config(config)
        goes_down = known is not None and revision != "head" and revision in _ancestors(script, known)
        (command.downgrade if goes_down else command.upgrade)(config, revision)
        _check_references(connection)


@contextmanager
def _loose(connection: Connection) -> Iterator[None]:
    """Let SQLite make tables anew that others refer to, which it does not while it guards the references.

    It takes this word only between transactions.
    """
    raw = connection.connection.driver_connection
    if connection.dialect.name != "sqlite" or raw is None:
        yield
        return
    raw.execute("PRAGMA foreign_keys=OFF")
    try:
        yield
    finally:
        raw.execute("PRAGMA foreign_keys=ON")


def _check_references(connection: Connection) -> None:
    if connection.dialect.name == "sqlite" and connection.execute(text("PRAGMA foreign_key_check")).first() is not None:
        raise ConflictError("the migration would leave rows that refer to nothing; nothing was changed")


def _ancestors(script: ScriptDirectory, revision: str) -> set[str]:
    return {"base", *(one.revision for one in script.iterate_revisions(revision, "base"))} - {revision}
