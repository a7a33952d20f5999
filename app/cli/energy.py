"""`magcal energy`: the energy balance of an orbit and the gravity that it gives, as the jobs compute them."""

from __future__ import annotations

import csv
import json
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import click

from app.cli.options import INPUT_FILE, OUTPUT_FILE, Names, orbits_of_file, usage_error
from magcal_core.errors import OptionError

if TYPE_CHECKING:
    from rich.console import Console

    from magcal_core.energy.balance import EnergyBalance
    from magcal_core.orbit import Orbit


def _forms() -> Collection[str]:
    from magcal_core.energy.forms import FORMS

    return FORMS


def _methods() -> Collection[str]:
    from magcal_core.energy.options import METHODS

    return METHODS


@click.command("energy")
@click.option("--state", type=INPUT_FILE, help="State vector, JSON {epoch, frame, position_km, velocity_km_s}.")
@click.option("--oem", type=INPUT_FILE, help="CCSDS OEM ephemeris; its own states are balanced, from its start.")
@click.option(
    "--tle", type=INPUT_FILE, help="TLE; integrated from its state at the epoch, or with --orbit sgp4 as it is."
)
@click.option("--duration", "duration_s", type=float, help="s; without it a day, or the whole ephemeris.")
@click.option("--step", "step_s", type=float, default=30.0, show_default=True, help="s.")
@click.option("--orbit", type=click.Choice(["numerical", "sgp4"]), default="numerical", show_default=True)
@click.option("--degree", type=int, default=12, show_default=True, help="Degree and order of EGM96, 0 to 36.")
@click.option("--third-bodies/--no-third-bodies", default=True, show_default=True, help="Sun and Moon.")
@click.option("--tide", is_flag=True, help="Solid tide, k2 = 0.30.")
@click.option("--form", type=Names(_forms), default="corrected", show_default=True)
@click.option("--recover", type=int, help="Recover C_nm, S_nm up to this degree.")
@click.option("--method", type=Names(_methods),
              default="least-squares", show_default=True, help="Of the recovery.")  # fmt: skip
@click.option("--noise-position-m", type=float, default=0.0, help="White noise that the recovery sees, 1 sigma.")
@click.option("--noise-velocity-m-s", type=float, default=0.0, help="White noise that the recovery sees, 1 sigma.")
@click.option("--seed", type=int, default=0, help="Seed of the noise.")
@click.option("--rotation", type=click.Choice(["iers", "uniform"]), default="iers", show_default=True,
              help="The Earth as it turns, or the ideal one about a fixed axis.")  # fmt: skip
@click.option("--drag-density-kg-m3", type=float, default=0.0, help="At the radius of the state; 0 for no drag.")
@click.option("--drag-area-over-mass-m2-kg", type=float, default=0.0, help="Cd A / m.")
@click.option("--drag-scale-height-km", type=float, default=65.0, show_default=True)
@click.option("--series", type=OUTPUT_FILE, help="Write every term to this CSV file.")
@click.option("--plot", type=OUTPUT_FILE, help="Draw every term, and the errors of --recover, on an HTML page.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def command(
    state: Path | None,
    oem: Path | None,
    tle: Path | None,
    series: Path | None,
    plot: Path | None,
    as_json: bool,
    **spec: float | bool | str | None,
) -> None:
    """Balance the energy along an orbit; recover gravity coefficients from it with --recover.

    H = v^2/2 - w.(r x v) - U - int a.(v - w x r) dt - tidal work stays constant where frames, potential and
    integrator agree: its standard deviation is the test. Exactly one of --state, --oem and --tle is wanted.
    """
    from magcal_core.energy.balance import energy_balance
    from magcal_core.energy.options import EnergyOptions

    given = [path for path in (state, oem, tle) if path is not None]
    if len(given) != 1:
        raise click.UsageError(f"want exactly one of --state, --oem and --tle, not {len(given)}")
    orbit = _orbit_of(given[0])
    if spec["duration_s"] is None:
        spec["duration_s"] = _length_s(orbit)
    try:
        options = EnergyOptions.from_dict(spec)
    except OptionError as error:
        raise usage_error(error) from error
    balance = energy_balance(orbit, options)
    if series is not None:
        _write_series(balance, series)
    if plot is not None:
        _draw(balance, plot)
    if as_json:
        click.echo(json.dumps(balance.to_dict()))
    else:
        _print_table(balance)


def _orbit_of(path: Path) -> Orbit:
    """Return the first orbit in a file; say so where there are more."""
    orbits = orbits_of_file(path)
    if len(orbits) > 1:
        first = f"{orbits[0].epoch_utc}Z"
        click.echo(f"magcal: {path} has {len(orbits)} orbits; the first, of {first}, is used", err=True)
    return orbits[0]


def _length_s(orbit: Orbit) -> float:
    """Return how long an ephemeris is, s; a day for other orbits."""
    from magcal_core.orbit.ephemeris.oem import OemOrbit

    if not isinstance(orbit, OemOrbit):
        return 86400.0
    return float((orbit.until_utc - orbit.epoch_utc).astype("timedelta64[ns]").astype(int)) / 1e9


def _write_series(balance: EnergyBalance, path: Path) -> None:
    """Write H and every term as CSV, times in UTC."""
    import numpy as np

    columns = balance.columns()
    times = [f"{text}Z" for text in np.datetime_as_string(balance.t_utc, unit="us")]
    with path.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["time", *(f"{name}_m2_s2" for name in columns)])
        for k, time in enumerate(times):
            writer.writerow([time, *(f"{series[k]:.17g}" for series in columns.values())])


def _draw(balance: EnergyBalance, path: Path) -> None:
    """Draw H and every term that acts, and what was recovered, on an HTML page."""
    import numpy as np

    from app.reporting.figures import coefficient_errors, energy_terms
    from app.reporting.figures.page import figure_page

    acting = {name: series for name, series in balance.columns().items() if np.ptp(series) > 0.0}
    figures = {"Terms less their means, m²/s²": energy_terms(balance.t_utc, acting)}
    recovery = balance.recovery
    if recovery is not None:
        degrees = np.arange(2, recovery.degree + 1, dtype=np.float64)
        errors = {f"error, {recovery.method}": recovery.error_by_degree}
        figures["Recovered coefficients"] = coefficient_errors(degrees, recovery.signal_by_degree, errors)
    title = f"Energy balance, {balance.orbit_model}, form {balance.options.form}"
    path.write_text(figure_page(title, figures), encoding="utf-8")


def _print_table(balance: EnergyBalance) -> None:
    """Print the balance for people."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    span_h = float((balance.t_utc[-1] - balance.t_utc[0]).astype("timedelta64[s]").astype(int)) / 3600.0
    title = f"Energy balance, {balance.orbit_model}, {span_h:g} h, form {balance.options.form}: {balance.consistency}"
    table = Table(title=title)
    table.add_column("m2/s2")
    for head in ("mean", "std", "peak to peak"):
        table.add_column(head, justify="right")
    for name, spread in {"H": balance.spread, "H + frame_rate": balance.frame_free}.items():
        table.add_row(name, f"{spread.mean:.4f}", f"{spread.std:.4g}", f"{spread.peak_to_peak:.4g}", style="bold")
    for name, series in balance.terms.items():
        table.add_row(name, f"{series.mean():.4f}", f"{series.std():.4g}", f"{series.max() - series.min():.4g}")
    console.print(table)
    console.print(f"drift of H: {balance.drift_m2_s2_per_day:.4g} m2/s2 per day")
    if balance.recovery is not None:
        _print_recovery(balance, console)
    for warning in balance.warnings:
        console.print(f"warning: {warning}", style="yellow")


def _print_recovery(balance: EnergyBalance, console: Console) -> None:
    """Print how well each degree was recovered."""
    from rich.table import Table

    recovery = balance.recovery
    if recovery is None:
        return
    title = f"Degree {recovery.degree} by {recovery.method}: rms error {recovery.rms_error:.3g}, "
    table = Table(title=f"{title}residual {recovery.residual_rms_m2_s2:.3g} m2/s2")
    table.add_column("degree", justify="right")
    table.add_column("error / signal", justify="right")
    for n, relative in enumerate(recovery.relative_error_by_degree, start=2):
        table.add_row(str(n), f"{relative:.3g}")
    console.print(table)
