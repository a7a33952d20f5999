"""`magcal demo`: a whole mission on this machine."""

from __future__ import annotations

import click


@click.command("demo")
@click.option("--once", is_flag=True, help="Exit after the result instead of going on serving.")
@click.option("--port", type=click.IntRange(0, 65535), help="Port to serve on.  [default: a free one]")
def command(once: bool, port: int | None) -> None:
    """Run a whole mission: a server, a worker, DEKART, its orbit, two sessions, their calibrations."""
    from app.demo.show import run_demo

    run_demo(port=0 if port is None else port, once=once)
