"""`magcal which-object`: of the objects of a launch, the one that a session is of."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from app.cli.calibrate import Declared, Reading, read_all, telemetry_options
from app.cli.options import INPUT_FILE, collect_rarely

if TYPE_CHECKING:
    from collections.abc import Mapping

    from magcal_core.which_object import WhichObject


@click.command("which-object")
@click.argument("telemetry", nargs=-1, required=True,
                type=click.Path(exists=True, dir_okay=False, allow_dash=True, path_type=Path))  # fmt: skip
@click.option("--tle", "--orbit-file", "orbit_files", type=INPUT_FILE, multiple=True, required=True,
              help="Orbits of all objects, in any form; may be repeated.")  # fmt: skip
@click.option("--max-orbit-age-days", type=float, default=14.0, show_default=True,
              help="Refuse orbits further from the data.")  # fmt: skip
@telemetry_options
@click.option("--json", "as_json", is_flag=True, help="Print the answer as JSON.")
def command(
    *,
    telemetry: tuple[Path, ...],
    orbit_files: tuple[Path, ...],
    max_orbit_age_days: float,
    unit: str,
    columns: Mapping[str, str] | None,
    kind: str | None,
    range_nt: float | None,
    time_scale: str,
    max_bad_fraction: float,
    any_field: bool,
    corrected_with: Path | None,
    as_json: bool,
    **declared: object,
) -> None:
    """Tell of which object TELEMETRY is, by the residuals that the orbits of each leave.

    The clock of the telemetry is taken as it is: objects of one launch follow each other along one track.
    """
    collect_rarely()
    from magcal_core.orbit.sources import parse_sources
    from magcal_core.reference.columns import orbit_spans
    from magcal_core.which_object import which_object

    if corrected_with is not None:
        raise click.UsageError("--corrected-with has no place here: the sensor is calibrated with each orbit anew")
    sources = [source for path in orbit_files for source in parse_sources(path.read_bytes())]
    said = Declared(**declared)  # type: ignore[arg-type]
    spans = orbit_spans([source.orbit for source in sources])
    reading = Reading(unit, columns, kind, range_nt, time_scale, max_bad_fraction, not any_field, said, spans)
    samples, _ = read_all(telemetry, reading)
    found = which_object(samples, sources, max_orbit_age_days=max_orbit_age_days)
    if as_json:
        click.echo(json.dumps(found.to_dict()))
    else:
        _print(found)


def _print(found: WhichObject) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("object", "name", "epoch", "age, d", "residual, nT", "behind the first, sigma")
    for one in found.objects:
        residual = one.reason or "" if one.residual_nt is None else f"{one.residual_nt:.1f}"
        behind = "" if one.behind_first is None else f"{one.behind_first:.1f}"
        table.add_row(one.norad_id or one.cospar_id, one.name, one.epoch, f"{one.age_days:.1f}", residual, behind)
    click.echo(f"{found.state}: {found.text}")
    Console().print(table)
