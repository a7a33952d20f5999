"""`magcal worker`: job workers alone."""

from __future__ import annotations

import click


@click.command("worker")
@click.option("--concurrency", type=click.IntRange(1, 64), help="Jobs at once.  [default: one per CPU, at most 4]")
def command(concurrency: int | None) -> None:
    """Work on jobs, on any machine that reaches the database, until told to stop."""
    from app.settings import load_settings
    from app.worker import work

    settings = load_settings()
    work(settings, settings.workers if concurrency is None else concurrency)
