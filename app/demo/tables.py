"""What the demonstration prints: truth and estimates, residuals before and after, the drift between the sessions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from rich.table import Table

from app.records.parameter_set import ParameterSetRecord, parameter_set_record, parameter_values

if TYPE_CHECKING:
    from app.client.blocking import Record
    from magcal_core.simulation.dekart_mission import Pass

LABELS: Final = {"bias_nt": ("b", "nT", 1), "scale": ("k", "", 5), "nonorthogonality_deg": ("e", "deg", 3)}
"""Group of parameters -> its letter, its unit and its decimals."""


def parameter_table(session: Pass, found: Mapping[str, Record]) -> Table:
    """Return the true parameters of a session beside each method's estimate and standard error."""
    table = Table(title=f"{session.name}, {session.samples} samples: estimate ± standard error", title_justify="left")
    table.add_column("parameter")
    table.add_column("truth", justify="right")
    for method in found:
        table.add_column(method, justify="right")
    records = {method: parameter_set_record(record) for method, record in found.items()}
    sensor = session.sensor
    for group, (letter, unit, decimals) in LABELS.items():
        for axis in range(3):
            truth = getattr(sensor, group)[axis]
            cells = [_with_error(record, f"{group}[{axis}]", decimals) for record in records.values()]
            table.add_row(f"{letter}{axis + 1} {unit}".rstrip(), f"{truth:.{decimals}f}", *cells)
    return table


def _with_error(record: ParameterSetRecord, name: str, decimals: int) -> str:
    value = parameter_values(record["parameters"])[name]
    error = parameter_values(record["standard_errors"])[name]
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"


def statistics_table(session: Pass, found: Mapping[str, Record]) -> Table:
    """Return the residuals of a session before and after each method, nT, and its verdict."""
    table = Table(title=f"{session.name}: residual before and after, nT", title_justify="left")
    table.add_column("method", no_wrap=True)
    for when in ("before", "after"):
        for name in ("mean", "std", "rms", "max"):
            table.add_column(f"{when}\n{name}", justify="right")
    table.add_column("cross-\nvalid.", justify="right")
    table.add_column("verdict")
    for method, values in found.items():
        record = parameter_set_record(values)
        statistics = record["statistics"]
        cells = [
            f"{value:.1f}"
            for found_nt in (statistics["before"], statistics["after"])
            for value in (found_nt["mean_nt"], found_nt["std_nt"], found_nt["rms_nt"], found_nt["max_abs_nt"])
        ]
        validated = statistics["cross_validated_rms_nt"]
        table.add_row(method, *cells, "" if validated is None else f"{validated:.1f}", record["verdict"]["grade"])
    return table


def drift_table(found: Sequence[Record]) -> Table:
    """Return how the parameters moved from the first session to the second, and how sure that is."""
    first, second = (parameter_set_record(record) for record in found)
    table = Table(title="drift between the sessions, scalar method", title_justify="left")
    for name in ("parameter", "session 1", "session 2", "change", "standard error", "sigma"):
        table.add_column(name, justify="left" if name == "parameter" else "right")
    values = [parameter_values(record["parameters"]) for record in (first, second)]
    errors = [parameter_values(record["standard_errors"]) for record in (first, second)]
    for group, (letter, unit, decimals) in LABELS.items():
        for axis in range(3):
            name = f"{group}[{axis}]"
            change, error = values[1][name] - values[0][name], math.hypot(errors[0][name], errors[1][name])
            numbers = [values[0][name], values[1][name], change, error]
            cells = [f"{number:.{decimals}f}" for number in numbers]
            table.add_row(f"{letter}{axis + 1} {unit}".rstrip(), *cells, f"{abs(change) / error:.1f}")
    return table
