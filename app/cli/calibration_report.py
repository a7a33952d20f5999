"""A calibration printed for people: the verdict first, then what to beware of, then the figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.table import Table

    from magcal_core.calibration.result import Calibration
    from magcal_core.sensor.parameters import Parameters

COLOURS: Final = {"accept": "green", "weak": "yellow", "refuse": "red"}
GROUPS: Final = (
    ("bias", "nT", "{:,.2f}"),
    ("scale", "", "{:.6f}"),
    ("angle", "deg", "{:.4f}"),
)


def print_calibration(calibration: Calibration) -> None:
    """Print verdict, reasons, warnings, parameters with both kinds of errors, and the residuals before and after."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False)
    verdict = calibration.verdict
    colour = COLOURS.get(verdict.grade, "white")
    console.print(f"[bold {colour}]{verdict.grade}[/]  {calibration.method}, {calibration.samples} samples, ", end="")
    console.print(f"{calibration.field_model}, {calibration.orbit_model}")
    for reason in verdict.reasons:
        console.print(f"  {escape(reason.code)}: {escape(reason.text)}")
    for warning in calibration.warnings:
        console.print(f"  [yellow]warning[/] {escape(warning)}")
    console.print(_parameter_table(calibration))
    console.print(_residual_table(calibration))
    for line in _closing_lines(calibration):
        console.print(escape(line))


def _parameter_table(calibration: Calibration) -> Table:
    from rich.table import Table

    table = Table(title="parameters", title_justify="left")
    table.add_column("parameter")
    for heading in ("estimate", "1 sigma", "if noise were white"):
        table.add_column(heading, justify="right")
    honest, formal = calibration.standard_errors, calibration.formal_standard_errors
    for (label, shown), value, one, other in zip(
        _labels(calibration.parameters),
        calibration.parameters.vector,
        honest.vector,
        formal.vector,
        strict=True,
    ):
        table.add_row(label, shown.format(value), shown.format(one), shown.format(other))
    return table


def _labels(parameters: Parameters) -> Iterator[tuple[str, str]]:
    """Yield the label and the number format of every parameter, in the order of their names."""
    from magcal_core.sensor.regressors import is_of_scale, source_of

    for label, unit, shown in GROUPS:
        for axis in "123":
            yield f"{label} {axis}" + (f", {unit}" if unit else ""), shown
    for name in parameters.regressors:
        for axis in "123":
            if is_of_scale(name):
                yield f"scale {axis} per {source_of(name)}", "{:.7f}"
            else:
                yield f"bias {axis} per {name}, nT", "{:,.3f}"
    if parameters.time_offset_s is not None:
        yield "clock offset, s", "{:.3f}"


def _residual_table(calibration: Calibration) -> Table:
    from rich.table import Table

    is_scalar = calibration.residuals.residual_nt.ndim == 1
    table = Table(title="residual |B| - |model|" if is_scalar else "residual B - model", title_justify="left")
    table.add_column("nT")
    for heading in ("mean", "std", "rms", "max", "max, %"):
        table.add_column(heading, justify="right")
    for label, statistics in (("before", calibration.before), ("after", calibration.after)):
        numbers = (statistics.mean_nt, statistics.std_nt, statistics.rms_nt, statistics.max_abs_nt)
        table.add_row(label, *(f"{number:,.1f}" for number in numbers), f"{statistics.max_percent:.2f}")
    return table


def _closing_lines(calibration: Calibration) -> Iterator[str]:
    if calibration.cross_validated_rms_nt is not None:
        yield f"cross-validated rms {calibration.cross_validated_rms_nt:,.1f} nT"
    observability = calibration.observability
    yield (
        f"observability {observability.index:.1f}, condition {observability.condition_number:.3g}, "
        f"sphere covered {100 * observability.sphere_coverage:.0f} %, rejected {calibration.rejected}"
    )
    for direction in observability.weak_directions:
        yield f"weak: {direction}"
