"""`magcal db`: look after the database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from app.settings import Settings
    from app.storage.database import Database


@contextmanager
def opened() -> Iterator[tuple[Database, Settings]]:
    """Yield the database that the settings name, with the settings."""
    from app.settings import Settings
    from app.storage.database import Database

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
    from app.storage.migration import current, migrate
    from app.storage.migration import upgrade as to_head

    with opened() as (database, settings):
        if revision == "head":
            to_head(database, settings)
        else:
            migrate(database, revision)
        click.echo(current(database) or "empty")


@command.command("current")
def show_current() -> None:
    """Print the revision of the database's schema, and the one that this version needs."""
    from app.storage.migration import current, head

    with opened() as (database, _):
        found = current(database)
    click.echo(f"{found or 'empty'} (this version needs {head()})")


@command.command("audit")
@click.option("--json", "as_json", is_flag=True, help="Print the audit as JSON.")
def show_audit(as_json: bool) -> None:
    """Check that everything acknowledged is there, byte for byte; exit 1 where something is amiss."""
    import json

    from app.maintenance.audit import audit, lines_of
    from app.storage.open_store import open_store

    with opened() as (database, settings):
        found = audit(database, open_store(settings))
    click.echo(json.dumps(found.to_dict()) if as_json else "\n".join(lines_of(found)))
    if found.findings:
        raise click.exceptions.Exit(1)


@command.command("rebuild")
def make_again() -> None:
    """Make the columnar form of all telemetry again from its raw bytes."""
    from app.maintenance.rebuild import rebuild
    from app.storage.open_store import open_store

    with opened() as (database, settings):
        done = rebuild(database, open_store(settings), settings)
    click.echo(f"{done.chunks} chunks read, {done.changed} made anew, {done.without_bytes} without their raw bytes")


@command.command("copy")
@click.argument("target_url", metavar="TARGET_URL")
def copy_to(target_url: str) -> None:
    """Copy the database to another one, TARGET_URL, which is brought to this schema and must be empty."""
    from app.maintenance.copy_database import copy
    from app.settings import Settings
    from app.storage.database import Database
    from app.storage.migration import upgrade as to_head

    with opened() as (source, settings):
        target_settings = settings.model_copy(update={"database_url": target_url})
        target = Database(Settings.model_validate(target_settings))
        try:
            to_head(target, target_settings)
            counts = copy(source, target)
        finally:
            target.close()
    click.echo("\n".join(f"{name}: {count} rows" for name, count in counts.items()))


@command.command("retention")
@click.option("--apply", "is_meant", is_flag=True, help="Remove; without it, only say what would be removed.")
def run_retention(is_meant: bool) -> None:
    """Remove raw bytes and chunks that are past their satellite's retention; parameter sets stay."""
    from app.maintenance.retention import expired, remove_expired
    from app.storage.open_store import open_store

    with opened() as (database, settings):
        found = remove_expired(database, open_store(settings)) if is_meant else expired(database)
    for one in found:
        click.echo(f"{one.session_id}  {one.satellite_id}  {one.data_until}  {one.size_bytes / 1e6:.3f} MB")
    total_mb = sum(one.size_bytes for one in found) / 1e6
    click.echo(f"{len(found)} sessions, {total_mb:.3f} MB {'removed' if is_meant else 'would be removed'}")
