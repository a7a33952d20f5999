"""`magcal orbits`: keep the satellites' orbits fresh from a catalogue."""

from __future__ import annotations

import signal
import sys

import click

from app.connectors.orbits.registry import ORBIT_SOURCES

SOURCES = tuple(ORBIT_SOURCES)


@click.group("orbits")
def command() -> None:
    """Keep the satellites' orbits fresh from a catalogue."""


@command.command("watch")
@click.option("--source", type=click.Choice(SOURCES), help="Where from.  [default: MAGCAL_ORBIT_SOURCE]")
@click.option("--once", is_flag=True, help="Ask for those whose turn it is, and exit.")
def watch(*, source: str | None, once: bool) -> None:
    """Fetch the orbit of every satellite that has a NORAD id, again and again.

    One request a satellite in MAGCAL_ORBIT_EVERY_H hours, over restarts too; any answer but 200 stops the source until
    `magcal orbits start SOURCE`.
    """
    from app.cli.db import opened
    from app.connectors.orbits.watch import OrbitWatch, stopped
    from app.connectors.orbits.watcher import OrbitWatcher
    from app.logs import configure_logs
    from app.storage.migration import upgrade

    with opened() as (database, settings):
        configure_logs(settings)
        upgrade(database, settings)
        name = source or settings.orbit_source
        if name is None:
            raise click.UsageError("--source or MAGCAL_ORBIT_SOURCE says where from")
        if not once:
            watcher = OrbitWatcher(database, settings, name)
            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, lambda *_: watcher.end())
            watcher.run()
            return
        looked = OrbitWatch(database, settings, name)
        for one in looked.round():
            click.echo(f"{one.satellite_id}: {one.state}" + (f": {one.why}" if one.why else ""))
        looked.release()
        with database.read() as session:
            stop = stopped(session, name)
        if stop is not None:
            click.echo(f"magcal: {name} is stopped: {stop.reason}", err=True)
            sys.exit(1)


@command.command("start")
@click.argument("source", type=click.Choice(SOURCES))
def start(source: str) -> None:
    """Let a source that had to be stopped be asked again."""
    from app.cli.db import opened
    from app.connectors.orbits.watch import start_again

    with opened() as (database, _), database.write() as session:
        was_stopped = start_again(session, source)
    click.echo(f"{source} may be asked again" if was_stopped else f"{source} was not stopped")
