"""`magcal serve`: the API, the dashboard and, on the embedded default, the job workers."""

from __future__ import annotations

import click


@click.command("serve")
@click.option("--host", help="Address to listen on.  [default: 127.0.0.1, or MAGCAL_HOST]")
@click.option("--port", type=click.IntRange(0, 65535), help="Port to listen on.  [default: 8000, or MAGCAL_PORT]")
@click.option(
    "--workers",
    type=click.IntRange(0, 64),
    help="Job workers of this process, on SQLite; on PostgreSQL `magcal worker` works.",
)
def command(host: str | None, port: int | None, workers: int | None) -> None:
    """Serve the API and the dashboard; on SQLite, work on the jobs too."""
    from app.settings import load_settings

    given = {"host": host, "port": port, "workers": workers}
    settings = load_settings().model_copy(update={name: value for name, value in given.items() if value is not None})
    if workers and settings.is_postgres:
        click.echo("--workers: on PostgreSQL the server works on no jobs; run `magcal worker` beside it", err=True)

    from app.server import serve  # which takes seconds: a wrong setting is told before

    serve(settings)
