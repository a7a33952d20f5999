"""`magcal calibrate`: telemetry files in, parameter set out, with no server."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from app.cli.calibration_report import print_calibration
from app.cli.options import (
    INPUT_FILE,
    OUTPUT_FILE,
    ColumnMap,
    F,
    FieldModels,
    LateProgress,
    Names,
    TableFile,
    Windows,
    added,
    collect_rarely,
    field_options,
    orbits_of_file,
    sources_of,
    usage_error,
    write_table,
)
from magcal_core.errors import InputError, MagcalError, OptionError
from magcal_core.options import (
    BIAS_STEPS,
    GYRO_UNITS,
    LOCKED_TERMS,
    NOISE_MODELS,
    ORBIT_MODELS,
    RESPONSES,
    ROBUST_LOSSES,
    TIME_OFFSETS,
    CalibrationOptions,
)
from magcal_core.units import COUNTS, NT_PER_UNIT, TIME_SCALES

if TYPE_CHECKING:
    from magcal_core.calibration.result import Calibration
    from magcal_core.calibration.sessions.monitoring import ActiveSet
    from magcal_core.samples import Samples
    from magcal_core.telemetry import Telemetry
    from magcal_core.telemetry.iso_times import Spans

STDIN: Final = "-"


def _formats() -> Collection[str]:
    from magcal_core.telemetry.formats import READERS

    return READERS


def _methods() -> Collection[str]:
    from magcal_core.calibration.estimators.registry import ESTIMATORS

    return ESTIMATORS


def telemetry_options(function: F) -> F:
    """Add the options of how telemetry is read."""
    return added(function, [
        click.option("--unit", type=click.Choice([*NT_PER_UNIT, COUNTS]), default="nT", show_default=True,
                     help="Unit of the readings."),
        click.option("--nt-per-count", type=float, help="nT in one count, where the unit is counts."),
        click.option("--columns", type=ColumnMap(), help='The file\'s own names: {"time": "ts", "bx": "mag_0", ...}.'),
        click.option("--format", "kind", type=Names(_formats),
                     help="Format.  [default: told by the file's ending or its first bytes]"),
        click.option("--range", "range_nt", type=float, help="Range of the sensor, nT: readings beyond are saturated."),
        click.option("--time-scale", type=click.Choice(TIME_SCALES), default="utc", show_default=True,
                     help="Scale that the times are kept on."),
        click.option("--time-format",
                     help="Form of the times where it is neither ISO 8601 with a zone nor seconds since 1970: utc, "
                          "unix-ms, gps, gps-week, j2000, jd, mjd, doy, boot, .. or a pattern: '%d.%m.%Y %H:%M'."),
        click.option("--time-epoch", help="Instant that --time-format boot counts from; the year of doy."),
        click.option("--fill", "fill_values", type=float, multiple=True,
                     help="Number that stands for a missing reading, in the unit of the file; any number of them."),
        click.option("--validity-column", help="Column that says which readings are good."),
        click.option("--valid-value", "valid_values", multiple=True,
                     help="Value of it that does.  [default: all but 0, false, invalid, ..]"),
        click.option("--max-bad", "max_bad_fraction", type=click.FloatRange(0, 1), default=0.5, show_default=True,
                     help="Share of samples without a reading or reference that is still accepted."),
        click.option("--any-field", is_flag=True,
                     help="Do not check the unit by |B| in low Earth orbit: other orbits, laboratory data."),
        click.option("--corrected-with", type=INPUT_FILE,
                     help="Parameter set that the satellite corrected the readings with; it is taken back first."),
    ])  # fmt: skip


def _orbit_options(function: F) -> F:
    """Add the options of where the satellite was."""
    return added(function, [
        click.option("--tle", type=INPUT_FILE, multiple=True, help="TLEs, any number."),
        click.option("--state", type=INPUT_FILE, multiple=True,
                     help="State vector, JSON {epoch, frame, position_km, velocity_km_s}."),
        click.option("--orbit-file", type=INPUT_FILE, multiple=True, help="TLE, OMM, OEM or state vector."),
        click.option("--candidate-tles", type=INPUT_FILE, multiple=True,
                     help="TLEs of other objects: where the fit fails, the one that explains the readings is named."),
        click.option("--orbit", type=click.Choice(ORBIT_MODELS), help="How elements are propagated.  [default: sgp4]"),
        click.option("--max-orbit-age-days", type=float, help="Refuse orbits further from the data.  [default: 14]"),
        click.option("--field", type=FieldModels(), help="Field model.  [default: igrf]"),
        click.option("--field-max-degree", type=int, help="Cut the field model at this degree."),
    ])  # fmt: skip


def _estimation_options(function: F) -> F:
    """Add the options of what is estimated, and how."""
    return added(function, [
        click.option("--method", type=Names(_methods), help="Estimator.  [default: scalar]"),
        click.option("--time-offset", type=click.Choice(TIME_OFFSETS), help="Clock offset.  [default: auto]"),
        click.option("--time-drift", is_flag=True, default=None, help="Estimate a drift of the clock as well."),
        click.option("--regressors", help="Columns that move the bias: a,b,.. or auto; a*h: the scale."),
        click.option("--response", type=click.Choice(RESPONSES),
                     help="Whether auto tries h^2, h^3 and dh/dt too.  [default: none]"),
        click.option("--robust", type=click.Choice(ROBUST_LOSSES), help="Loss.  [default: auto]"),
        click.option("--noise-model", type=click.Choice(NOISE_MODELS), help="[default: auto]"),
        click.option("--noise", "noise_nt", type=float, help="Noise of a component, nT, where it is known."),
        click.option("--integration", "integration_s", type=float,
                     help="Seconds about its time stamp over which the sensor averages a reading."),
        click.option("--bias-steps", type=click.Choice(BIAS_STEPS),
                     help="Steps of the bias inside the data: named, fitted, or not looked for.  [default: auto]"),
        click.option("--windows", type=Windows(),
                     help="Calibrate windows of so many hours, or auto, one by one as well, with their trend."),
        click.option("--locked-terms", type=click.Choice(LOCKED_TERMS),
                     help="Errors of the bias that follow orbit, heat and sun.  [default: auto]"),
        click.option("--without", multiple=True,
                     help="Span of time to leave out, FROM/UNTIL in ISO 8601 with Z; any number of them."),
        click.option("--gyro", help="Columns of the angular rate, wx,wy,wz: they tell how the sensor is mounted."),
        click.option("--gyro-unit", type=click.Choice(GYRO_UNITS), help="Unit of the gyros.  [default: deg/s]"),
        click.option("--bootstrap", type=int, help="Replicates of the block bootstrap.  [default: 0]"),
        click.option("--seed", type=int, help="Seed of the bootstrap.  [default: 0]"),
    ])  # fmt: skip


@click.command("calibrate")
@click.argument("telemetry", nargs=-1, required=True,
                type=click.Path(exists=True, dir_okay=False, allow_dash=True, path_type=Path))  # fmt: skip
@_orbit_options
@field_options
@_estimation_options
@telemetry_options
@click.option("--active", type=INPUT_FILE, help="Parameter set in force: the verdict tells where the new one differs.")
@click.option("--json", "as_json", is_flag=True, help="Print the parameter set as JSON.")
@click.option("--residuals", type=TableFile(), help="Write the residual table.")
@click.option("-o", "--output", type=OUTPUT_FILE, help="Write the parameter set as JSON to this file too.")
def command(
    *,
    telemetry: tuple[Path, ...],
    tle: tuple[Path, ...],
    state: tuple[Path, ...],
    orbit_file: tuple[Path, ...],
    candidate_tles: tuple[Path, ...],
    index: tuple[Path, ...],
    field_file: Path | None,
    unit: str,
    nt_per_count: float | None,
    columns: Mapping[str, str] | None,
    kind: str | None,
    range_nt: float | None,
    time_scale: str,
    time_format: str | None,
    time_epoch: str | None,
    fill_values: tuple[float, ...],
    validity_column: str | None,
    valid_values: tuple[str, ...],
    max_bad_fraction: float,
    any_field: bool,
    corrected_with: Path | None,
    active: Path | None,
    as_json: bool,
    residuals: Path | None,
    output: Path | None,
    **asked: str | float | None,
) -> None:
    """Calibrate a magnetometer from TELEMETRY: one file or several, or - for stdin.

    Without reference columns in the telemetry (ref_bx.., ref_b, ref_eci_x.., x_km..) an orbit is needed.
    """
    collect_rarely()
    from magcal_core.pipeline import calibrate
    from magcal_core.reference.columns import orbit_spans

    options = _options(asked)
    orbits = [orbit for path in (*tle, *state, *orbit_file) for orbit in orbits_of_file(path)]
    candidates = [orbit for path in candidate_tles for orbit in orbits_of_file(path)]
    declared = Declared(nt_per_count, time_format, time_epoch, fill_values, validity_column, valid_values)
    reading = Reading(
        unit, columns, kind, range_nt, time_scale, max_bad_fraction, not any_field, declared, orbit_spans(orbits)
    )
    with failures_as_json(as_json):
        samples, inputs = read_all(telemetry, reading)
    if corrected_with is not None:
        samples = _uncorrected(samples, corrected_with, inputs)
    with LateProgress("calibrating") as progress, failures_as_json(as_json):
        sources = sources_of(index, field_file)
        calibration = calibrate(
            samples,
            orbits,
            options,
            index=sources.indices,
            field_file=sources.file,
            active=_in_force(active),
            candidates=candidates,
            progress=progress,
        )
    record = parameter_set(calibration, inputs)
    if residuals is not None:
        _write_residuals(calibration, residuals)
    if output is not None:
        output.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if as_json:
        click.echo(json.dumps(record))
    else:
        print_calibration(calibration)


@contextmanager
def failures_as_json(is_wanted: bool) -> Iterator[None]:
    """Print what fails inside as JSON on stdout, where that is wanted, before it goes on to stderr and exit status."""
    try:
        yield
    except MagcalError as error:
        if is_wanted:
            from app.records.json_numbers import without_nan

            told = {"code": error.code, "detail": error.message, "diagnosis": error.diagnosis}
            click.echo(json.dumps(without_nan({"error": {**told, "data_quality": error.data_quality}})))
        raise


@dataclass(frozen=True, slots=True)
class Declared:
    """What is declared of telemetry that does not say it itself."""

    nt_per_count: float | None = None
    time_format: str | None = None
    time_epoch: str | None = None
    fill_values: tuple[float, ...] = ()
    validity_column: str | None = None
    valid_values: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Reading:
    """How telemetry files are read."""

    unit: str
    columns: Mapping[str, str] | None
    kind: str | None
    range_nt: float | None
    time_scale: str
    max_bad_fraction: float
    is_field_checked: bool
    declared: Declared
    orbit_spans: Spans

    def read(self, path: Path) -> tuple[Telemetry, str]:
        """Return the telemetry of one file, or of stdin, and the SHA-256 of its bytes."""
        from magcal_core.telemetry import format_of_name, read_telemetry
        from magcal_core.telemetry.quality import LEO_FIELD_NT

        content = sys.stdin.buffer.read() if str(path) == STDIN else path.read_bytes()
        telemetry = read_telemetry(
            content,
            columns=self.columns,
            unit=self.unit,
            format=self.kind or format_of_name(path),
            range_nt=self.range_nt,
            time_scale=self.time_scale,
            nt_per_count=self.declared.nt_per_count,
            time_format=self.declared.time_format,
            time_epoch=self.declared.time_epoch,
            fill_values=self.declared.fill_values,
            validity_column=self.declared.validity_column,
            valid_values=self.declared.valid_values,
            orbit_spans=self.orbit_spans,
            field_range_nt=LEO_FIELD_NT if self.is_field_checked else None,
            max_bad_fraction=self.max_bad_fraction,
        )
        return telemetry, hashlib.sha256(content).hexdigest()


def read_all(paths: tuple[Path, ...], reading: Reading) -> tuple[Samples, list[dict[str, object]]]:
    """Return the samples of all files, and what they were."""
    from magcal_core.telemetry import merge_samples

    parts: list[Samples] = []
    inputs: list[dict[str, object]] = []
    for path in paths:
        try:
            telemetry, digest = reading.read(path)
        except InputError as error:
            if len(paths) > 1:
                error.message = f"{path}: {error.message}"
            raise
        parts.append(telemetry.samples)
        inputs.append({"name": path.name, "sha256": digest, "quality": telemetry.quality.to_dict()})
    return merge_samples(parts), inputs


def _uncorrected(samples: Samples, path: Path, inputs: list[dict[str, object]]) -> Samples:
    """Return the raw readings of samples that the parameter set in ``path`` has corrected, and note it at their inputs.

    Raises
    ------
    InputError
        The file is not a parameter set, or the samples lack one of its regressors.
    """
    from app.parameter_sets.correction import Correction
    from app.records.parameter_set import parse_parameter_set

    content = path.read_bytes()
    correction = Correction.of(parse_parameter_set(content))
    for one in inputs:
        one["corrected_with_sha256"] = hashlib.sha256(content).hexdigest()
    return correction.unapply(samples)


def _in_force(path: Path | None) -> ActiveSet | None:
    """Return the parameter set in the file ``path``, where one is given.

    Raises
    ------
    InputError
        The file is not a parameter set.
    """
    if path is None:
        return None
    from app.records.parameter_set import parse_parameter_set
    from magcal_core.calibration.sessions.monitoring import ActiveSet

    return ActiveSet.from_record(parse_parameter_set(path.read_bytes()))


def _options(asked: Mapping[str, object]) -> CalibrationOptions:
    """Return the options that were given on the command line; the others keep their defaults."""
    given = {name: value for name, value in asked.items() if value is not None}
    regressors = given.get("regressors")
    if isinstance(regressors, str) and regressors != "auto":
        given["regressors"] = tuple(name.strip() for name in regressors.split(",") if name.strip())
    if isinstance(gyro := given.get("gyro"), str):
        given["gyro"] = tuple(name.strip() for name in gyro.split(",") if name.strip())
    try:
        return CalibrationOptions.from_dict(given)
    except OptionError as error:
        raise usage_error(error) from error


def parameter_set(calibration: Calibration, inputs: list[dict[str, object]]) -> dict[str, object]:
    """Return the parameter set of a calibration as the service has it, without the ids that only the service knows."""
    from importlib.metadata import version

    from app.records.json_numbers import without_nan

    record = calibration.to_dict()
    provenance = record["provenance"]
    software = {"name": "magcal-service", "version": version("magcal-service")}
    record["created_at"] = datetime.now(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    record["provenance"] = {"software": software, "inputs": inputs} | (
        provenance if isinstance(provenance, dict) else {}
    )
    finite = without_nan(record)
    return finite if isinstance(finite, dict) else record


def _write_residuals(calibration: Calibration, path: Path) -> None:
    from app.records.residual_table import residual_table

    write_table(residual_table(calibration.residuals), path)
