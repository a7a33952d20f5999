"""`magcal push`: what a ground station runs after a pass, or all the time over the folder that its receiver fills."""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from magcal_client.errors import ClientError, one_line

if TYPE_CHECKING:
    from magcal_client.blocking import Client
    from magcal_client.station import Outcome, Station

LONGEST_PAUSE_S: Final = 60.0


@click.command("push")
@click.argument("telemetry", type=click.Path(exists=True, path_type=Path))
@click.option("--satellite", required=True, help="The satellite's id.")
@click.option("--magnetometer", required=True, help="The magnetometer's id.")
@click.option("--url", envvar="MAGCAL_URL", default="http://127.0.0.1:8000", show_default=True, help="The service.")
@click.option("--key", envvar="MAGCAL_KEY", required=True, help="A key with the scope ingest; better in MAGCAL_KEY.")
@click.option("--watch", is_flag=True, help="TELEMETRY is a folder: go on sending what arrives in it.")
@click.option("--settle", "settle_s", type=click.FloatRange(min=0), default=5.0, show_default=True,
              help="Seconds for which a file of a folder must not change before it counts as whole.")  # fmt: skip
@click.option("--poll", "poll_s", type=click.FloatRange(min=0.05), default=1.0, show_default=True,
              help="Seconds between two looks into the folder.")  # fmt: skip
@click.option("--follow-links", is_flag=True, help="Also send files that are symbolic links in the folder.")
@click.option("--json", "as_json", is_flag=True, help="Print the session, or one line a file, as JSON.")
def command(
    *,
    telemetry: Path,
    satellite: str,
    magnetometer: str,
    url: str,
    key: str,
    watch: bool,
    settle_s: float,
    poll_s: float,
    follow_links: bool,
    as_json: bool,
) -> None:
    """Send TELEMETRY, a file or a folder of files, to a magcal service.

    Safe to repeat: the same bytes are the same session, and what the network loses is sent again. A file of a folder is
    moved to its subfolder sent/ when the service has its bytes on disk, to refused/ (with its faults in NAME.why) where
    the service will never take it, and stays where it is while the service cannot be reached. What lies in sent/ is
    asked for again, and sent again where the service does not have it: after a restore from a backup, push once.
    """
    from magcal_client.blocking import Client
    from magcal_client.folder import taken
    from magcal_client.station import Destination, Station

    if not telemetry.is_dir():
        if watch:
            raise click.UsageError("--watch wants a folder")
        with Client(url, key) as client:
            _push_file(client, telemetry, satellite, magnetometer, as_json=as_json)
        return
    signal.signal(signal.SIGIO, signal.SIG_IGN)
    stop = threading.Event()
    if watch:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stop.set())
    with taken(telemetry), Client(url, key, tries=2, wait=stop.wait) as client:
        station = Station(
            telemetry,
            client,
            Destination(satellite, magnetometer),
            settle_s=settle_s,
            follow_links=follow_links,
            is_stopped=stop.is_set,
        )
        if watch:
            _watch(station, stop, poll_s, as_json=as_json)
        elif not _push_once(station, settle_s, as_json=as_json):
            raise SystemExit(1)


def _push_file(client: Client, path: Path, satellite: str, magnetometer: str, *, as_json: bool) -> None:
    from rich.console import Console
    from rich.progress import Progress

    from magcal_client.requests import media_type_of

    content = path.read_bytes()
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(path.name, total=1.0)
        session = client.upload(
            satellite, magnetometer, content, media_type_of(path), lambda share: bar.update(task, completed=share)
        )
    if as_json:
        click.echo(json.dumps(session))
    else:
        click.echo(
            f"session {session['id']}: {session['samples']} samples, {session['data_from']}..{session['data_until']}"
        )


def _push_once(station: Station, settle_s: float, *, as_json: bool) -> bool:
    """Send what lies in the folder and does not change; return whether nothing was refused or kept."""
    station.look()
    time.sleep(settle_s)
    outcomes = []
    for outcome in station.send_all():
        _tell(outcome, as_json=as_json)
        outcomes.append(outcome)
    return all(outcome.state == "sent" for outcome in outcomes)


def _watch(station: Station, stop: threading.Event, poll_s: float, *, as_json: bool) -> None:
    """Send what arrives until ``stop``; look less often while something cannot be sent."""
    pause_s = poll_s
    told: dict[str, str | None] = {}
    while not stop.is_set():
        kept: dict[str, str | None] = {}
        for outcome in station.send_all():
            if outcome.state == "kept":
                kept[outcome.name] = outcome.why
            if outcome.state != "kept" or told.get(outcome.name) != outcome.why:
                _tell(outcome, as_json=as_json)
            if stop.is_set():
                break
        told = kept
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S) if kept else poll_s
        stop.wait(pause_s)


def _tell(outcome: Outcome, *, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(asdict(outcome)))
    elif outcome.state == "sent":
        click.echo(shown(f"{outcome.name}: session {outcome.session_id}"))
    else:
        click.echo(shown(f"{outcome.name}: {outcome.state}: {outcome.why}"), err=True)


def shown(text: str) -> str:
    """Return ``text``, which came from outside, with everything escaped that a terminal would obey or cannot show."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in text)


def run() -> None:
    """Run the command by itself: exit status 0 done, 1 failed, 2 wrong usage."""
    try:
        command(prog_name="magcal-push")
    except ClientError as error:
        click.echo(one_line(error, "magcal-push"), err=True)
        sys.exit(1)
    except OSError as error:
        click.echo(f"magcal-push: {error}", err=True)
        sys.exit(1)
