"""`magcal pull`: telemetry from an archive, into the database that the settings name."""

from __future__ import annotations

import json
import signal
import sys
import threading
from datetime import timedelta
from pathlib import Path
from typing import Final

import click

from app.connectors.telemetry.contract import LOOK_BACK
from app.connectors.telemetry.registry import ARCHIVES

LOOK_EVERY_S: Final = 300.0


def _columns(text: str | None) -> dict[str, str]:
    """Return a map of columns given as JSON, or as a file of it."""
    if text is None:
        return {}
    try:
        found = json.loads(text if text.lstrip().startswith("{") else Path(text).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise click.BadParameter('want JSON such as {"bx": "/ADCS/mag_x"}, or a file of it') from error
    if not isinstance(found, dict) or not all(isinstance(one, str) for one in found.values()):
        raise click.BadParameter("want an object of names")
    return found


@click.command("pull")
@click.argument("source", type=click.Choice(tuple(ARCHIVES)))
@click.option("--base-url", required=True, help="The archive's address.")
@click.option("--satellite", required=True, help="The satellite's id.")
@click.option("--magnetometer", required=True, help="The magnetometer's id.")
@click.option("--columns", help="JSON or a file of it: column of the telemetry table -> name of the archive.  "
              "[default: the magnetometer's columns]")  # fmt: skip
@click.option("--dataset", "--instance", "dataset", help="Yamcs' instance, HAPI's dataset, SatNOGS' NORAD id.")
@click.option("--since", help="Where the first pull begins, ISO 8601 with a zone.")
@click.option("--history", is_flag=True, help="Yamcs: the history of each parameter, page by page, not the export.  "
              "[default: where there is no export]")  # fmt: skip
@click.option("--settle", type=click.FloatRange(0.0, 10_000.0), default=0.0, metavar="HOURS",
              help="Leave for later what is younger: recordings that come down with a pass, frames of slow stations.  "
              "[default: 0]")  # fmt: skip
@click.option("--look-back", type=click.FloatRange(0.0, 10_000.0), default=LOOK_BACK / timedelta(hours=1),
              metavar="HOURS", help="Look so far back for what came late; 0: not at all.  [default: 72]")  # fmt: skip
@click.option("--token", envvar="MAGCAL_PULL_TOKEN", help="The archive's token; better in MAGCAL_PULL_TOKEN.")
@click.option("--once", is_flag=True, help="Pull what there is now, and exit.")
def command(
    *,
    source: str,
    base_url: str,
    satellite: str,
    magnetometer: str,
    columns: str | None,
    dataset: str | None,
    since: str | None,
    history: bool,
    settle: float,
    look_back: float,
    token: str | None,
    once: bool,
) -> None:
    """Pull telemetry from SOURCE into sessions, from where the last pull ended; safe to kill at any time."""
    from app.cli.db import opened
    from app.connectors.telemetry.contract import Wanted, instant
    from app.connectors.telemetry.pull import Pull
    from app.jobs.engines.open_engine import open_engine
    from app.storage.migration import upgrade
    from app.storage.open_store import open_store
    from app.uploads.ingest import Ingest

    try:
        begin = None if since is None else instant(since)
    except ValueError as error:
        raise click.BadParameter("want a time in ISO 8601, such as 2026-11-22T10:00:00Z") from error
    wanted = Wanted(base_url, _columns(columns), dataset, begin, token, history, timedelta(hours=settle),
                    timedelta(hours=look_back))  # fmt: skip
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with opened() as (database, settings):
        upgrade(database, settings)
        store = open_store(settings)
        ingest = Ingest(database, store, open_engine(database, store, settings, 0).queue, settings)
        archive = (source, ARCHIVES[source])
        pull = Pull(database, settings, ingest, archive=archive, satellite_id=satellite,
                    magnetometer_id=magnetometer, wanted=wanted)  # fmt: skip
        while not stop.is_set():
            for page in pull.run():
                if page.session_id is not None:
                    click.echo(f"session {page.session_id}: {page.rows} rows" + ("" if page.is_new else ", known"))
                    sys.stdout.flush()
                if stop.is_set():
                    return
            if once:
                return
            stop.wait(LOOK_EVERY_S)
