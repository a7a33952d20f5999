"""`magcal convert`: the parameters of a magnetometer from one convention to another, loss-free."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from magcal_core.errors import OptionError

if TYPE_CHECKING:
    from collections.abc import Mapping

EXACT: Final = "exact"
CONVENTION_LIST: Final = "exact, first-order, symmetric, lower-triangular, a-matrix or on-board"


@click.command("convert")
@click.argument("parameters", type=click.Path(exists=True, dir_okay=False, allow_dash=True, path_type=Path))
@click.option("--from", "source", default=EXACT, show_default=True, help=f"Convention given: {CONVENTION_LIST}.")
@click.option("--to", "target", required=True, help="Convention wanted.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(parameters: Path, source: str, target: str, as_json: bool) -> None:
    """Convert PARAMETERS, a JSON file or - for stdin, between parameter conventions, loss-free.

    The file is either the parameters alone, such as {"bias_nt": [..], "scale": [..], "nonorthogonality_deg": [..]} or
    {"bias_nt": [..], "matrix": [[..], ..]}, or a parameter set as `magcal calibrate --json` prints it, whose
    parameters are exact.
    """
    from magcal_core.sensor.conventions import CONVENTIONS, convert

    for option, name in (("--from", source), ("--to", target)):
        if name not in CONVENTIONS:
            raise click.BadParameter(f"{name!r}: want one of {', '.join(CONVENTIONS)}", param_hint=option)
    given = _read(parameters)
    inside = given.get("parameters")
    if isinstance(inside, dict):
        if source != EXACT:
            raise click.UsageError("the parameters of a parameter set are exact: leave --from out")
        given = inside
    converted = {"convention": target} | convert(given, source, target)
    if as_json:
        click.echo(json.dumps(converted))
    else:
        _print(converted)


def _read(path: Path) -> dict[str, object]:
    text = sys.stdin.read() if str(path) == "-" else path.read_text(encoding="utf-8")
    try:
        value = json.loads(text)
    except ValueError as error:
        raise OptionError(f"{path}: not JSON: {error}") from error
    if not isinstance(value, dict):
        raise OptionError(f"{path}: want a JSON object")
    return value


def _print(converted: Mapping[str, object]) -> None:
    """Print the parameters for people."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{converted['convention']} parameters")
    table.add_column("parameter")
    for axis in "123":
        table.add_column(axis, justify="right")
    for name, value in converted.items():
        rows = value if isinstance(value, list) else []
        for row in rows if rows and isinstance(rows[0], list) else [rows] if rows else []:
            table.add_row(name, *(f"{number:.12g}" for number in row))
    Console().print(table)
