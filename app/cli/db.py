"""`magcal db`: look after the database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from app.settings import Settings
    from app.storage.database import Database
    from app.storage.store import Store


@contextmanager
def opened(*, may_be_new: bool = False) -> Iterator[tuple[Database, Settings]]:
    """Yield the database that the settings name, with the settings; one that is not there is made only on request."""
    from app.settings import load_settings
    from app.storage.database import Database
    from app.storage.identity import refuse_lost, require_database

    settings = load_settings()
    (refuse_lost if may_be_new else require_database)(settings)
    database = Database(settings)
    try:
        yield database, settings
    finally:
        database.close()


@contextmanager
def opened_with_store() -> Iterator[tuple[Database, Store, Settings]]:
    """Yield the database with its own store; one that is another's is refused."""
    from app.storage.identity import require_own
    from app.storage.migration import require_head
    from app.storage.open_store import open_store

    with opened() as (database, settings):
        require_head(database)
        store = open_store(settings)
        require_own(database, store, settings)
        yield database, store, settings


@click.group("db")
def command() -> None:
    """Look after the database."""


@command.command("upgrade")
@click.argument("revision", default="head")
def upgrade(revision: str) -> None:
    """Bring the database to this version's schema, or to REVISION, up or down."""
    from app.storage.migration import current, migrate
    from app.storage.migration import upgrade as to_head

    with opened(may_be_new=True) as (database, settings):
        if revision == "head":
            to_head(database, settings)
        else:
            migrate(database, revision)
        click.echo(current(database) or "empty")


@command.command("current")
def show_current() -> None:
    """Print the revision of the database's schema, and the one that this version needs."""
    from app.settings import load_settings
    from app.storage.identity import is_made, refuse_lost
    from app.storage.migration import current, head

    settings, found = load_settings(), None
    refuse_lost(settings)
    if is_made(settings):
        with opened() as (database, _):
            found = current(database)
    click.echo(f"{found or 'empty'} (this version needs {head()})")


@command.command("audit")
@click.option("--json", "as_json", is_flag=True, help="Print the audit as JSON.")
@click.option(
    "--receipts",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    multiple=True,
    help="A station's sent/receipts.ndjson: each of its files must be here. May be given more than once.",
)
def show_audit(*, as_json: bool, receipts: tuple[Path, ...]) -> None:
    """Check that everything acknowledged is there, byte for byte; exit 1 where something is amiss."""
    import json

    from app.maintenance.audit import audit, lines_of

    with opened_with_store() as (database, store, _):
        found = audit(database, store, receipts)
    click.echo(json.dumps(found.to_dict()) if as_json else "\n".join(lines_of(found)))
    if found.findings:
        raise click.exceptions.Exit(1)


@command.command("rebuild")
def make_again() -> None:
    """Make the columnar form of all telemetry again from its raw bytes; exit 1 where some of it cannot be."""
    from app.maintenance.rebuild import rebuild

    with opened_with_store() as (database, store, settings):
        done = rebuild(database, store, settings)
    for one in done.failed:
        click.echo(f"{one.session_id}/{one.sequence}: {one.why}", err=True)
    click.echo(
        f"{done.chunks} chunks read, {done.changed} made anew, {done.without_bytes} without their raw bytes, "
        f"{len(done.failed)} failed"
    )
    if done.failed:
        raise click.exceptions.Exit(1)


@command.command("copy")
@click.argument("target_url", metavar="TARGET_URL")
@click.option(
    "--skip", "may_skip", is_flag=True, help="Name the rows that the target does not take, and copy the rest."
)
def copy_to(target_url: str, *, may_skip: bool) -> None:
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
            copied = copy(source, target, may_skip=may_skip)
        finally:
            target.close()
    click.echo("\n".join(f"{name}: {count} rows" for name, count in copied.counts.items()))
    for one in copied.skipped:
        click.echo(f"left out: {one}", err=True)
    if copied.skipped:
        raise click.exceptions.Exit(1)


@command.command("retention")
@click.option("--apply", "is_meant", is_flag=True, help="Remove; without it, only say what would be removed.")
def run_retention(is_meant: bool) -> None:
    """Remove raw bytes and chunks that are past their satellite's retention; parameter sets stay."""
    from app.maintenance.retention import expired, remove_expired

    with opened_with_store() as (database, store, _):
        found = remove_expired(database, store) if is_meant else expired(database)
    for one in found:
        click.echo(f"{one.session_id}  {one.satellite_id}  {one.data_until}  {one.size_bytes / 1e6:.3f} MB")
    total_mb = sum(one.size_bytes for one in found) / 1e6
    click.echo(f"{len(found)} sessions, {total_mb:.3f} MB {'removed' if is_meant else 'would be removed'}")


@command.command("adopt")
@click.option("--apply", "is_meant", is_flag=True, help="Do it; without it, only say what belongs to what.")
def adopt_store(is_meant: bool) -> None:
    """Make database, store and data folder belong together, after one of them was moved or made anew on purpose."""
    from app.storage.database import new_id
    from app.storage.identity import adopt, found_identity, place_of, remembered
    from app.storage.migration import alone, require_head
    from app.storage.open_store import open_store

    with opened() as (database, settings):
        require_head(database)
        store = open_store(settings)
        with database.read() as session:
            row = found_identity(session)
        memory = remembered(settings)
        click.echo(f"database {place_of(settings)}: {'new' if row is None else row.database_id}")
        click.echo(f"data folder {settings.data_dir}: {'new' if memory is None else memory.database_id}")
        click.echo(f"store {settings.store_url or 'in the database'}: {store.marker() or 'no marker'}")
        if is_meant:
            database_id = new_id() if row is None else row.database_id
            with alone(database, settings):
                adopt(database, store, settings, database_id)
            click.echo(f"they belong together now, as {database_id}")


@command.command("remove-satellite")
@click.argument("satellite")
@click.option("--confirm", help="What the command prints without it: removes exactly that.")
def remove_one_satellite(satellite: str, confirm: str | None) -> None:
    """Remove SATELLITE with all it has, its jobs cancelled; without --confirm, only say what that is."""
    from dataclasses import asdict

    from app.access.caller import SYSTEM
    from app.maintenance.removal import remove_objects
    from app.maintenance.satellite_removal import holdings_of, remove_satellite

    with opened_with_store() as (database, store, _):
        if confirm is None:
            with database.read() as session:
                found = holdings_of(session, SYSTEM, satellite)
        else:
            with database.write() as session:
                found = remove_satellite(session, SYSTEM, satellite, confirm)
            remove_objects(database, store)
    click.echo("\n".join(f"{name}: {value}" for name, value in asdict(found).items()))
    click.echo("removed" if confirm else f"to remove it: --confirm {found.confirmation(satellite)}")
