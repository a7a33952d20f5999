"""`magcal simulate`: telemetry of a tumbling satellite, with its truth beside it."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from app.cli.options import (
    INPUT_FILE,
    F,
    FieldModels,
    Numbers,
    TableFile,
    VectorCommand,
    added,
    field_options,
    nearest,
    orbits_of_file,
    sources_of,
    usage_error,
)
from magcal_core.errors import InputError, OptionError

if TYPE_CHECKING:
    import numpy as np

    from magcal_core.orbit import Orbit
    from magcal_core.simulation.telemetry import Simulation

VECTOR: Final = Numbers(3)


def _disturbance_options(function: F) -> F:
    """Add the options of what stands between field and telemetry."""
    return added(function, [
        click.option("--noise", "noise_nt", type=float, default=0.0, show_default=True, help="1 sigma, nT."),
        click.option("--outliers", "outlier_fraction", type=float, default=0.0, help="Share of readings with a spike."),
        click.option("--outlier-size", "outlier_nt", type=float, default=5000.0, show_default=True, help="Spike, nT."),
        click.option("--dropouts", "dropout_fraction", type=float, default=0.0, help="Share of samples that are lost."),
        click.option("--range", "range_nt", type=float, help="Readings are cut at plus and minus this, nT."),
        click.option("--time-offset", "time_offset_s", type=float, default=0.0,
                     help="Seconds to add to the telemetry's clock to have true time."),
        click.option("--temperature", "temperature_nt_per_k", type=VECTOR, default="0,0,0",
                     help="Bias per kelvin, nT/K; adds a column temperature."),
        click.option("--temperature-period", "temperature_period_s", type=float, default=5700.0, show_default=True,
                     help="s."),
        click.option("--wave", "wave_nt", type=VECTOR, default="0,0,0", help="Wave of the bias, nT, in no column."),
        click.option("--wave-period", "wave_period_s", type=float, default=2400.0, show_default=True, help="s."),
        click.option("--drift", "drift_nt_per_h", type=VECTOR, default="0,0,0", help="Drift of the bias, nT/h."),
        click.option("--attitude-noise", "attitude_noise_deg", type=float, default=0.0,
                     help="Error of the attitude sent, 1 sigma, deg."),
    ])  # fmt: skip


@click.command("simulate", cls=VectorCommand)
@click.option("--tle", type=INPUT_FILE, help="TLE; of several, the one nearest to the start.")
@click.option("--state", type=INPUT_FILE, help="State vector, JSON {epoch, frame, position_km, velocity_km_s}.")
@click.option("--start", help="UTC of the first sample, ISO 8601 with a zone.  [default: the orbit's epoch]")
@click.option("--duration", "duration_s", type=float, required=True, help="s.")
@click.option("--step", "step_s", type=float, default=10.0, show_default=True, help="Between samples, s.")
@click.option("--bias", "bias_nt", type=VECTOR, default="0,0,0", help="Zero offset, nT.")
@click.option("--scale", type=VECTOR, default="1,1,1", help="Scale factors.")
@click.option("--eps", "nonorthogonality_deg", type=VECTOR, default="0,0,0", help="Angles e1,e2,e3, deg.")
@click.option("--rate", "rate_deg_s", type=Numbers(1, 3), default="0.76", show_default=True,
              help="Tumbling rate, deg/s: its size, or its body components.")  # fmt: skip
@click.option("--inertia", type=VECTOR, help="Principal moments, any unit.  [default: those of a 7.5 kg box]")
@click.option("--field", default="igrf", show_default=True, type=FieldModels(), help="Field model.")
@field_options
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@_disturbance_options
@click.option("-o", "--output", type=TableFile(), required=True,
              help="Telemetry; .gz or .zst may come after its ending.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the truth as JSON.")
def command(
    *,
    tle: Path | None,
    state: Path | None,
    start: str | None,
    duration_s: float,
    step_s: float,
    bias_nt: tuple[float, ...],
    scale: tuple[float, ...],
    nonorthogonality_deg: tuple[float, ...],
    rate_deg_s: tuple[float, ...],
    inertia: tuple[float, ...] | None,
    field: str,
    index: tuple[Path, ...],
    field_file: Path | None,
    index_gap: str | None,
    quiet_only: bool | None,
    seed: int,
    output: Path,
    as_json: bool,
    **disturbances: float | tuple[float, ...] | None,
) -> None:
    """Simulate the telemetry of a satellite that tumbles freely: time, bx, by, bz in nT and the attitude qw..qz.

    The truth goes beside the telemetry, as OUT.truth.json. The same seed gives the same bytes. Three numbers are
    written 1,2,3 or 1 2 3.
    """
    import numpy as np

    from magcal_core.field.models import field_model
    from magcal_core.sensor.model import SensorModel
    from magcal_core.simulation.telemetry import DEKART_MOMENTS, Disturbances, simulate

    if (tle is None) == (state is None):
        raise click.UsageError("want exactly one of --tle and --state")
    t_start = None if start is None else _instant(start)
    orbit = _orbit(tle, state, t_start)
    sources = sources_of(index, field_file)
    try:
        sensor = SensorModel(np.array(bias_nt), np.array(scale), np.array(nonorthogonality_deg))
        simulation = simulate(
            orbit,
            sensor,
            orbit.epoch_utc if t_start is None else t_start,
            duration_s,
            step_s,
            field_model=field_model(field, index_gap=index_gap or "refuse", sources=sources),
            sources=sources,
            quiet_only=bool(quiet_only),
            rate_deg_s=rate_deg_s[0] if len(rate_deg_s) == 1 else rate_deg_s,
            moments=inertia or DEKART_MOMENTS,
            disturbances=Disturbances(**disturbances),  # type: ignore[arg-type]
            seed=seed,
        )
    except OptionError as error:
        raise usage_error(error) from error
    truth = _write(simulation, output)
    if as_json:
        click.echo(json.dumps({"telemetry": str(output), "truth": simulation.truth}))
    else:
        click.echo(f"{len(simulation.samples)} samples in {output}, their truth in {truth}")


def _instant(text: str) -> np.datetime64:

    from magcal_core.telemetry.iso_times import parse_iso_time

    try:
        return parse_iso_time(text)
    except InputError as error:
        raise click.BadParameter(f"{text!r}: {error.message}", param_hint="--start") from error


def _orbit(tle: Path | None, state: Path | None, start: np.datetime64 | None) -> Orbit:
    path = tle or state
    orbits = [] if path is None else orbits_of_file(path)
    return orbits[0] if start is None else nearest(orbits, start)


def _write(simulation: Simulation, output: Path) -> Path:
    """Write telemetry and truth; return where the truth is."""
    import zstandard

    from magcal_core.telemetry import format_of_name, write_samples

    body = write_samples(simulation.samples, str(format_of_name(output)))
    if output.suffix == ".gz":
        body = gzip.compress(body, mtime=0)
    elif output.suffix in {".zst", ".zstd"}:
        body = zstandard.compress(body)
    output.write_bytes(body)
    truth = output.with_name(f"{output.name}.truth.json")
    truth.write_text(json.dumps(simulation.truth, indent=1) + "\n", encoding="utf-8")
    return truth
