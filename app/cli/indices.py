"""`magcal indices`: fetch indices of the external field from where they are published."""

from __future__ import annotations

import sys
from datetime import UTC, datetime, timedelta

import click

from app.connectors.indices.registry import INDEX_SOURCES

SOURCES = tuple(INDEX_SOURCES)


@click.group("indices")
def command() -> None:
    """Fetch indices of the external field from where they are published."""


@command.command("fetch")
@click.argument("source", type=click.Choice(SOURCES))
@click.option("--since", help="Day from which on, YYYY-MM-DD.  [default: the first of last month]")
def fetch(*, source: str, since: str | None) -> None:
    """Fetch what SOURCE has since a day, once; run it from a timer.

    A file is asked for once in MAGCAL_INDEX_EVERY_H hours; any answer but 200 stops the source until
    `magcal indices start SOURCE`.
    """
    from app.cli.db import opened
    from app.connectors.indices.fetch import IndexFetch
    from app.logs import configure_logs
    from app.storage.migration import upgrade

    begin = _first_of_last_month() if since is None else _day(since)
    with opened() as (database, settings):
        configure_logs(settings)
        upgrade(database, settings)
        fetching = IndexFetch(database, settings, source)
        failed = False
        for one in fetching.run(begin):
            failed |= one.state == "failed"
            click.echo(f"{one.part}: {one.state}" + (f": {one.why}" if one.why else ""))
        stop = fetching.stopped()
    if stop is not None:
        click.echo(f"magcal: {source} is stopped: {stop}", err=True)
    if failed or stop is not None:
        sys.exit(1)


@command.command("start")
@click.argument("source", type=click.Choice(SOURCES))
def start(source: str) -> None:
    """Let a source that had to be stopped be asked again."""
    from app.cli.db import opened
    from app.connectors.indices.fetch import IndexFetch

    with opened() as (database, settings):
        was_stopped = IndexFetch(database, settings, source).start_again()
    click.echo(f"{source} may be asked again" if was_stopped else f"{source} was not stopped")


def _first_of_last_month() -> datetime:
    last = datetime.now(UTC).replace(day=1) - timedelta(days=1)
    return datetime(last.year, last.month, 1, tzinfo=UTC)


def _day(text: str) -> datetime:
    try:
        return datetime.strptime(text, "%Y-%m-%d").replace(tzinfo=UTC)
    except ValueError:
        raise click.BadParameter("a day is YYYY-MM-DD", param_hint="--since") from None
