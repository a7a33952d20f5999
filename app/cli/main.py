"""Entry point of `magcal`: knows the commands' names and loads each one only when it is called."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any, Final

import click

from app.kernels import bring_kernels
from magcal_client.errors import ClientError, one_line
from magcal_core.errors import InputError, MagcalError

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
"""Said before numpy is loaded, and handed down to jobs: matrices are small here, and a second thread of BLAS mostly
waits for a core that others work on. Where both are busy, a fit took three times as long with it."""

COMMANDS: Final[dict[str, str]] = {
    "demo": "A whole mission on this machine: server, worker, two sessions, their calibrations.",
    "serve": "The API, the dashboard and, on the embedded default, the job workers.",
    "worker": "Job workers alone, on any machine that reaches the database.",
    "calibrate": "Calibrate telemetry files with no server: files in, parameter set out.",
    "simulate": "Simulate the telemetry of a tumbling satellite, with its truth beside it.",
    "push": "Send telemetry to a magcal service; safe to repeat.",
    "trend": "Parameters over many sets: where they are now, how long the active set stays good.",
    "pull": "Pull telemetry from a Yamcs, SatNOGS or HAPI archive.",
    "orbits": "Keep the satellites' orbits fresh from a catalogue.",
    "indices": "Fetch indices of the external field from where they are published.",
    "which-object": "Tell of which object of a launch telemetry is, by the residuals that each one's orbit leaves.",
    "report": "The report of a parameter set as one HTML file, or PDF.",
    "convert": "Convert parameters between conventions, loss-free.",
    "rom": "Simulate attitude control by magnetometer, gyros and wheels.",
    "energy": "Balance the energy of an orbit, and recover gravity from it.",
    "keys": "Create, list and revoke API keys.",
    "db": "Look after the database: upgrade, current, audit, copy, rebuild.",
}
"""Command -> its line in `magcal --help`; the command itself is ``command`` in ``app.cli.<name>``."""


class LazyGroup(click.Group):
    """A group of commands that imports a command's module only when that command is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands' names in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a command."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"app.cli.{cmd_name.replace('-', '_')}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="magcal-service", prog_name="magcal")
def magcal() -> None:
    """In-flight magnetometer calibration: telemetry and a TLE in, a parameter set with honest errors out."""


def run(argv: list[str] | None = None) -> Any:
    """Run `magcal` and turn failures into one line on stderr and an exit status: 0 done, 1 failed, 2 wrong usage."""
    try:
        bring_kernels()
        return magcal.main(args=argv, prog_name="magcal", standalone_mode=True)
    except InputError as error:
        lines = [f"magcal: {error.code}: {error.message}", *(f"  {fault}" for fault in error.faults)]
        click.echo("\n".join(lines), err=True)
    except MagcalError as error:
        click.echo(f"magcal: {error.code}: {error.message}", err=True)
    except ClientError as error:
        click.echo(one_line(error, "magcal"), err=True)
    except OSError as error:
        click.echo(f"magcal: {error}", err=True)
    sys.exit(1)
