"""`magcal push`: what a ground station runs after a pass."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command("push")
@click.argument("telemetry", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--satellite", required=True, help="The satellite's id.")
@click.option("--magnetometer", required=True, help="The magnetometer's id.")
@click.option("--url", envvar="MAGCAL_URL", default="http://127.0.0.1:8000", show_default=True, help="The service.")
@click.option("--key", envvar="MAGCAL_KEY", required=True, help="A key with the scope ingest; better in MAGCAL_KEY.")
@click.option("--json", "as_json", is_flag=True, help="Print the session as JSON.")
def command(telemetry: Path, satellite: str, magnetometer: str, url: str, key: str, as_json: bool) -> None:
    """Send a file of telemetry to a magcal service.

    Safe to repeat: the same bytes are the same session, and what the network loses is sent again.
    """
    from rich.console import Console
    from rich.progress import Progress

    from app.client import Client, media_type_of

    content = telemetry.read_bytes()
    console = Console(stderr=True)
    with Client(url, key) as client, Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(telemetry.name, total=1.0)
        session = client.upload(
            satellite,
            magnetometer,
            content,
            media_type_of(telemetry),
            lambda share: bar.update(task, completed=share),
        )
    if as_json:
        click.echo(json.dumps(session))
    else:
        click.echo(
            f"session {session['id']}: {session['samples']} samples, {session['data_from']}..{session['data_until']}"
        )
