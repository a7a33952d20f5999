"""`magcal db`: look after the database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from app.database import Database
    from app.settings import Settings


@contextmanager
def opened() -> Iterator[tuple[Database, Settings]]:
    """Yield the database that the settings name, with the settings."""
    from app.database import Database
    from app.settings import Settings

    settings = Settings()
    database = Database(settings)
    try:
        yield database, settings
    finally:
        database.close()


@click.group("db")
def command() -> None:
    """Look after the database."""


@command.command("upgrade")
@click.argument("revision", default="head")
def upgrade(revision: str) -> None:
    """Bring the database to this version's schema, or to REVISION, up or down."""
    from app.migrate import current, migrate
    from app.migrate import upgrade as to_head

    with opened() as (database, settings):
        if revision == "head":
            to_head(database, settings)
        else:
            migrate(database, revision)
        click.echo(current(database) or "empty")


@command.command("current")
def show_current() -> None:
    """Print the revision of the database's schema, and the one that this version needs."""
    from app.migrate import current, head

    with opened() as (database, _):
        found = current(database)
    click.echo(f"{found or 'empty'} (this version needs {head()})")
