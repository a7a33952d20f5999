"""`magcal rom`: attitude restored and turned by magnetometer, gyros and wheels, as the jobs simulate it."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from app.cli.options import FieldModels
from magcal_core.attitude.option_values import CHOICES
from magcal_core.errors import InputError, OptionError

if TYPE_CHECKING:
    from collections.abc import Callable

    from magcal_core.attitude.options import RomOptions
    from magcal_core.attitude.rom import RomResult

F = TypeVar("F", bound="Callable[..., object]")


class Numbers(click.ParamType[tuple[float, ...]]):
    """Numbers with commas between them."""

    name = "A,B,C"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Return the numbers of ``value``."""
        try:
            return tuple(float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r}: want numbers with commas between them", param, ctx)


class ParameterSet(click.ParamType[object]):
    """A file with a parameter set, or with its parameters alone."""

    name = "FILE"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> object:
        """Return what the JSON file says."""
        path = Path(str(value))
        if not path.is_file():
            self.fail(f"there is no file {path}", param, ctx)
        try:
            return json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{path}: not JSON: {error}") from error


NUMBERS = Numbers()
FILE = ParameterSet()


def _orbit_options(function: F) -> F:
    """Add the options of orbit, field and time."""
    for option in reversed((
        click.option("--altitude-km", type=float, default=500.0, show_default=True, help="Above 6378.1363 km."),
        click.option("--inclination-deg", type=float, default=62.0, show_default=True),
        click.option("--u0-deg", type=float, default=0.0, help="Argument of latitude at the start."),
        click.option("--raan-deg", type=float, default=0.0, help="Right ascension of the ascending node."),
        click.option("--epoch", help="UTC of the start; without it 2020-01-01 with Greenwich on the X axis."),
        click.option("--field", type=FieldModels(), default="dipole", show_default=True, help="True field."),
        click.option("--onboard-field", type=FieldModels(), help="Field of the control law; the true one without it."),
        click.option("--duration-s", "--duration", type=float, default=10_000.0, show_default=True),
        click.option("--dt-s", "--dt", type=float, default=0.5, show_default=True, help="Control period."),
    )):  # fmt: skip
        function = option(function)
    return function


def _control_options(function: F) -> F:
    """Add the options of start, programme, law and body."""
    for option in reversed((
        click.option("--start", "start_deg", type=NUMBERS, default="0,0,0", help="psi,theta,gamma at the start, deg."),
        click.option("--start-rate", type=click.Choice(CHOICES["start_rate"]), default="inertial",
                     show_default=True, help="None in inertial space, the orbit's, or the orbit's along body axes."),
        click.option("--turn", "turn_deg", type=NUMBERS, help="Programmed turn psi,theta,gamma, deg."),
        click.option("--ramp-s", type=float, default=0.0, help="Duration of the turn; 0 for a step."),
        click.option("--kp", "kp_nm", type=float, default=0.05, show_default=True, help="Nm."),
        click.option("--kd", "kd_nms", type=float, default=20.0, show_default=True, help="Nms."),
        click.option("--propose-gains", "use_proposed_gains", is_flag=True, help="Gains for this orbit and body."),
        click.option("--form", type=click.Choice(CHOICES["form"]), default="corrected", show_default=True),
        click.option("--guard", is_flag=True, help="Turn away from the degenerate set, |q~| < 0.05."),
        click.option("--feed-forward", is_flag=True, help="Let the wheels take up the gyroscopic torque."),
        click.option("--inertia", "inertia_kg_m2", type=NUMBERS, default="70,90,80", show_default=True,
                     help="Jx,Jy,Jz or Jx,Jy,Jz,Jxy,Jxz,Jyz, kg m2."),
        click.option("--torque-limit-nm", type=float, default=0.05, show_default=True, help="Of each wheel."),
        click.option("--momentum-limit-nms", type=float, default=5.0, show_default=True, help="Of each wheel."),
        click.option("--gravity-gradient", is_flag=True, help="Let the gravity gradient turn the body."),
    )):  # fmt: skip
        function = option(function)
    return function


def _sensor_options(function: F) -> F:
    """Add the options of magnetometer and gyros."""
    for option in reversed((
        click.option("--sensor", type=FILE, help="Parameter set that the magnetometer really has."),
        click.option("--corrected-with", type=FILE, help="Parameter set that corrects its readings on board."),
        click.option("--eps-arcmin", type=NUMBERS, default="0,0,0", help="Non-orthogonality e1,e2,e3 of (4.1)."),
        click.option("--mounting-deg", type=NUMBERS, default="0,0,0", help="Mounting error psi,theta,gamma."),
        click.option("--mu-nt", type=NUMBERS, default="0,0,0", help="Error of the on-board model, orbital axes."),
        click.option("--common-scale", type=float, default=0.0, help="Error of scale common to the axes."),
        click.option("--bias-nt", type=NUMBERS, default="0,0,0", help="Zero offset."),
        click.option("--noise-nt", type=float, default=0.0, help="White noise of each reading, 1 sigma."),
        click.option("--gyro-bias-deg-s", type=NUMBERS, default="0,0,0"),
        click.option("--gyro-noise-deg-s", type=float, default=0.0, help="White noise of each rate, 1 sigma."),
        click.option("--seed", type=int, default=0, help="Seed of the noise."),
    )):  # fmt: skip
        function = option(function)
    return function


@click.command("rom")
@_orbit_options
@_control_options
@_sensor_options
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
@click.option("--series", type=click.Path(dir_okay=False, path_type=Path), help="Write the series to this CSV file.")
@click.option("--series-step-s", type=float, default=10.0, show_default=True, help="Step of the series.")
@click.option("--plot", type=click.Path(dir_okay=False, path_type=Path), help="Draw the error on an HTML page.")
@click.option("--sweep-eps-arcmin", "sweep", type=NUMBERS, metavar="A,B,...",
              help="With --plot: also the steady error at these non-orthogonalities, arcmin.")  # fmt: skip
def command(
    as_json: bool,
    series: Path | None,
    series_step_s: float,
    plot: Path | None,
    sweep: tuple[float, ...] | None,
    **spec: object,
) -> None:
    """Simulate attitude restoration (or, with --turn, a programmed turn) by magnetometer, gyros and wheels.

    Angles in deg: psi about Y (up), theta about Z, gamma about X, from the orbital axes to the body's.
    """
    from magcal_core.attitude.option_values import sensor_model
    from magcal_core.attitude.options import RomOptions
    from magcal_core.attitude.rom import simulate_rom

    for name in ("sensor", "corrected_with"):
        if spec[name] is not None:
            spec[name] = sensor_model(spec[name])
    try:
        options = RomOptions.from_dict(spec)
    except OptionError as error:
        raise click.UsageError("\n".join(str(fault) for fault in error.faults) or error.message) from error
    if sweep is not None and plot is None:
        raise click.UsageError("--sweep-eps-arcmin is drawn by --plot")
    result = simulate_rom(options.scenario())
    if plot is not None:
        _draw(options, result, plot, sweep or ())
    if series is not None:
        _write_series(result, series, max(1, round(series_step_s / options.dt_s)))
    if as_json:
        click.echo(json.dumps(result.to_dict()))
    else:
        _print_table(options, result)


def _write_series(result: RomResult, path: Path, every: int) -> None:
    """Write every ``every``-th step as CSV."""
    from numpy import rad2deg

    from magcal_core.attitude.rotation import attitude_matrix, euler_angles

    axes = "xyz"
    with path.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out, lineterminator="\n")
        wheels = [f"wheel_{a}_nms" for a in axes] + [f"torque_{a}_nm" for a in axes]
        writer.writerow(["time_s", "error_deg", "rate_error_deg_s", "psi_deg", "theta_deg", "gamma_deg", *wheels])
        for k in range(0, result.t_s.size, every):
            angles_deg = rad2deg(euler_angles(attitude_matrix(result.q[k])))
            row = (result.error_deg[k], result.rate_error_deg_s[k], *angles_deg)
            row = (*row, *result.wheel_momentum_nms[k], *result.torque_nm[k])
            writer.writerow([f"{result.t_s[k]:g}", *(f"{value:.9g}" for value in row)])


def _draw(options: RomOptions, result: RomResult, path: Path, sweep: tuple[float, ...]) -> None:
    """Draw the error of this run, of the raw magnetometer where this one is corrected, and the sweep."""
    from dataclasses import replace

    from app.reporting.figures import error_against_angle, settling
    from app.reporting.figures.page import figure_page
    from magcal_core.attitude.rom import simulate_rom
    from magcal_core.attitude.sweep import sweep_nonorthogonality

    errors = {"this run": result.error_deg}
    if options.corrected_with is not None:
        errors["raw"] = simulate_rom(replace(options, corrected_with=None).scenario()).error_deg
    figures = {"Attitude error": settling(result.t_s, errors)}
    if sweep:
        found = sweep_nonorthogonality(options.scenario(), sweep)
        curves = {"equal signs": found.equal_arcmin, "worst signs": found.worst_arcmin}
        figures["Error against non-orthogonality"] = error_against_angle(found.angle_arcmin, curves)
    path.write_text(figure_page(_title(options), figures), encoding="utf-8")


def _title(options: RomOptions) -> str:
    return f"ROM, {options.altitude_km:g} km, {options.inclination_deg:g} deg, {options.field}"


def _print_table(options: RomOptions, result: RomResult) -> None:
    """Print the summary for people."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=_title(options))
    table.add_column("figure")
    table.add_column("value", justify="right")
    for level in (10, 5, 1):
        time_s = result.settling_s(level)
        table.add_row(f"below {level} deg for good after", "never" if time_s is None else f"{time_s:,.1f} s")
    summary = result.to_dict()
    rows = {
        "final_error_deg": ("error at the end", "deg"),
        "max_error_last_two_orbits_deg": ("largest error, last two orbits", "deg"),
        "max_rate_error_deg_s": ("largest rate error, last two orbits", "deg/s"),
        "wheel_momentum_max_nms": ("largest momentum of a wheel", "Nms"),
        "torque_max_nm": ("largest torque of a wheel", "Nm"),
    }
    for name, (label, unit) in rows.items():
        table.add_row(label, f"{summary[name]:.4g} {unit}")
    Console().print(table)
