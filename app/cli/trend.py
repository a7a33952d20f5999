"""`magcal trend`: parameter sets in, the trend of their parameters and the life of the active one out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from app.cli.options import INPUT_FILE, TableFile, write_table
from magcal_core.errors import InputError, TimeError

if TYPE_CHECKING:
    import numpy as np

    from magcal_core.calibration.sessions.trend import Trend

SYMBOLS: Final = ("b", "k", "ε")
UNITS: Final = ("nT", "", "deg")
DIGITS: Final = (1, 6, 4)


class Instant(click.ParamType[int]):
    """A time in ISO 8601 with a zone, as nanoseconds since 1970, UTC."""

    name = "TIME"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the nanoseconds of ``value``."""
        from magcal_core.telemetry.iso_times import parse_iso_ns

        if isinstance(value, int):
            return value
        try:
            return parse_iso_ns(str(value))
        except TimeError as error:
            self.fail(f"{value!r}: {error.message}", param, ctx)


@click.command("trend")
@click.argument("files", nargs=-1, required=True, type=INPUT_FILE)
@click.option("--at", type=Instant(), help="Time that the trend is told for.  [default: the end of the last data]")
@click.option("--share", type=float, default=0.01, show_default=True, help="Share of the field that a set may be off.")
@click.option("--field-nt", type=float, default=40_000.0, show_default=True, help="Field that errors are told for, nT.")
@click.option("--series", type=TableFile(), help="Write the trend over time.")
@click.option("--json", "as_json", is_flag=True, help="Print the trend as JSON.")
def command(
    *, files: tuple[Path, ...], at: int | None, share: float, field_nt: float, series: Path | None, as_json: bool
) -> None:
    """Say where a magnetometer's parameters are and how long its active set stays good, from its parameter sets.

    FILES: parameter sets as `magcal calibrate --json` prints them, lists of them, or what the service lists.
    """
    import numpy as np

    from magcal_core.calibration.sessions.trend import trend

    sets = [one for path in files for one in sets_of_file(path)]
    found = trend(sets, None if at is None else np.datetime64(at, "ns"), share, field_nt)
    if series is not None:
        _write(found, series)
    if as_json:
        click.echo(json.dumps(found.to_dict()))
    else:
        _print(found)


def sets_of_file(path: Path) -> list[Mapping[str, object]]:
    """Return the parameter sets of a file: one, a list, or what the service answers.

    Raises
    ------
    InputError
        The file holds something else.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: not JSON: {error}") from error
    if isinstance(value, dict) and isinstance(value.get("items"), list):
        value = value["items"]
    found = value if isinstance(value, list) else [value]
    if not all(isinstance(one, dict) for one in found):
        raise InputError(f'{path}: want a parameter set, a list of them, or {{"items": [...]}}')
    return found


def _write(found: Trend, path: Path) -> None:
    from app.monitoring.trend_table import POINTS, series_of, trend_table

    write_table(trend_table(series_of(found, None, None, POINTS)), path)


def _print(found: Trend) -> None:
    """Print the trend for people."""
    from rich.console import Console
    from rich.table import Table

    from magcal_core.units import utc_text

    record, now = found.to_dict(), found.at(found.at_utc)
    table = Table(title=f"at {utc_text(found.at_utc)}, from {len(found.sets)} sets")
    table.add_column("parameter")
    table.add_column("value", justify="right")
    table.add_column("standard error", justify="right")
    for i in range(9):
        row, axis = divmod(i, 3)
        name = f"{SYMBOLS[row]}{axis + 1} {UNITS[row]}".rstrip()
        table.add_row(name, *(_fixed(values, i, DIGITS[row]) for values in (now.parameters, now.standard_errors)))
    console = Console()
    console.print(table)
    life = found.life()
    console.print(f"field off by at most {float(now.field_error_nt):.0f} nT of {found.field_nt:,.0f} nT (95 %)")
    console.print(f"set {life.parameter_set_id}: {life.text}", markup=False)
    for jump in found.jumps:
        console.print(f"jump: {jump.text}", markup=False)
    for label, reason in found.left_out:
        console.print(f"left out: {label} ({reason})", markup=False)
    for warning in record["warnings"] if isinstance(record["warnings"], list) else []:
        console.print(f"warning: {warning}", markup=False)


def _fixed(values: np.ndarray, i: int, digits: int) -> str:
    return f"{float(values[i]):,.{digits}f}"
