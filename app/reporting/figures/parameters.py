"""Figures of parameter sets: their history with honest error bars, their correlations, their choice of model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from app.records.parameter_set import (
    ParameterSetRecord,
    ParametersRecord,
    SetHistory,
    oldest_orbit_days,
    parameter_values,
)
from app.reporting.figures.style import (
    GRADE_SYMBOLS,
    LIGHT,
    Layout,
    Theme,
    Trace,
    axis,
    make_figure,
    milliseconds,
    scatter,
)
from magcal_core.arrays import Floats

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

GROUPS: Final = (
    ("bias_nt", "bias, nT", "b"),
    ("scale", "scale factor", "k"),
    ("nonorthogonality_deg", "angle, deg", "ε"),
)
"""Group of parameters -> its axis title and its letter."""
MOST_BARS: Final = 200
"""Sets up to which each has its bar and mark; more are drawn as a line in a band, which a browser draws at once."""


@dataclass(frozen=True, slots=True)
class AblationRow:
    """One model that was tried: its name and its residual RMS, nT, in the fit and cross-validated."""

    name: str
    rms_nt: float
    cross_validated_rms_nt: float | None
    is_chosen: bool


def parameter_history(sets: Sequence[SetHistory], theme: Theme = LIGHT) -> Figure:
    """Return bias, scale and angles of ``sets`` over the middle of their data, bars of one honest standard error.

    Nine panels, one a parameter, because a drift of tens of nT is invisible on an axis that spans all three biases.
    """
    ordered = sorted(sets, key=lambda record: record["data_from"])
    x = _middle_ms(ordered)
    traces: list[Trace] = []
    headings: list[Layout] = []
    layout: Layout = {"height": 620, "showlegend": False, "annotations": headings}
    for row, (group, title, letter) in enumerate(GROUPS):
        top = 1.0 - row * 0.35
        for i in range(3):
            number = 3 * row + i + 1
            name = "" if number == 1 else str(number)
            left = i * 0.35
            times = axis(theme, type="date", domain=[left, left + 0.28], anchor=f"y{name}", nticks=4)
            layout[f"xaxis{name}"] = times if number == 1 else times | {"matches": "x"}
            layout[f"yaxis{name}"] = axis(theme, domain=[top - 0.23, top], anchor=f"x{name}", nticks=5)
            unit = "" if group == "scale" else f", {title.split(', ')[1]}"
            headings.append(
                {"text": f"<b>{letter}{i + 1}</b>{unit}", "xref": "paper", "yref": "paper", "x": left, "y": top + 0.01}
                | {"xanchor": "left", "yanchor": "bottom", "showarrow": False}
            )
            place = {"x": x, "xaxis": f"x{name}", "yaxis": f"y{name}", "name": f"{letter}{i + 1}"}
            traces += [trace | place for trace in _history_traces(ordered, group, i, theme)]
    return make_figure(traces, theme, layout)


def tle_age_history(sets: Sequence[SetHistory], theme: Theme = LIGHT) -> Figure:
    """Return the age of the oldest orbit of each of ``sets`` with the limits of 3 and 14 days."""
    ordered = sorted(sets, key=lambda record: record["data_from"])
    ages = [oldest_orbit_days(record) for record in ordered]
    known = np.array([np.nan if age is None else age for age in ages])
    traces = _by_grade(ordered, known, theme)
    layout: Layout = {
        "height": 240,
        "xaxis": axis(theme, "UTC", type="date"),
        "yaxis": axis(theme, "orbit's age, days", rangemode="tozero"),
        "shapes": [
            {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": day, "y1": day}
            | {"line": {"color": theme.muted, "width": 1, "dash": "dot"}}
            for day in (3, 14)
            if any(age is not None and age > day / 2 for age in ages)
        ],
    }
    return make_figure(traces, theme, layout)


def rms_history(sets: Sequence[SetHistory], theme: Theme = LIGHT) -> Figure:
    """Return the residual RMS of ``sets`` after calibration, in the fit and cross-validated, marked by verdict."""
    ordered = sorted(sets, key=lambda record: record["data_from"])
    x = _middle_ms(ordered)
    fitted = np.array([record["statistics"]["after"]["rms_nt"] for record in ordered], dtype=np.float64)
    held_out = np.array([record["statistics"]["cross_validated_rms_nt"] for record in ordered], dtype=np.float64)
    traces: list[Trace] = [
        *_by_grade(ordered, fitted, theme),
        scatter(
            x,
            held_out,
            "markers",
            name="cross-validated",
            marker={"symbol": "line-ew-open", "size": 11, "color": theme.muted},
        ),
    ]
    layout: Layout = {
        "height": 280,
        "xaxis": axis(theme, "UTC", type="date"),
        "yaxis": axis(theme, "residual RMS, nT", rangemode="tozero"),
    }
    return make_figure(traces, theme, layout)


def correlation_matrix(record: ParameterSetRecord, theme: Theme = LIGHT) -> Figure:
    """Return the correlations of the parameters' honest covariance as a map with the numbers written in.

    Its colours are the inner ones of the scale, on which the ink can be read.
    """
    covariance = np.nan_to_num(np.array(record["covariance"], dtype=np.float64))
    correlation = correlation_of(covariance)
    names = [short_name(name) for name in record["parameter_names"]]
    trace: Trace = {
        "type": "heatmap",
        "x": names,
        "y": names,
        "z": np.round(correlation, 3),
        "zmin": -1.0,
        "zmax": 1.0,
        "colorscale": [[2.0 * at - 0.5, colour] for at, colour in theme.diverging[1:4]],
        "colorbar": {"thickness": 12, "outlinewidth": 0},
        "hovertemplate": "%{y}, %{x}: %{z:.2f}<extra></extra>",
        "xgap": 1,
        "ygap": 1,
    }
    if len(names) <= 12:
        trace |= {"text": [[f"{value:.2f}" for value in row] for row in correlation], "texttemplate": "%{text}"}
        trace["textfont"] = {"color": theme.ink}
    layout: Layout = {
        "height": 140 + 30 * max(len(names), 6),
        "xaxis": axis(theme, side="bottom", showgrid=False),
        "yaxis": axis(theme, autorange="reversed", showgrid=False),
    }
    return make_figure([trace], theme, layout)


def correlation_of(covariance: Floats) -> Floats:
    """Return the correlation matrix of a covariance; a parameter without variance correlates with nothing."""
    spread = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    scale = np.outer(spread, spread)
    result: Floats = np.divide(covariance, scale, out=np.zeros_like(covariance), where=scale > 0)
    np.fill_diagonal(result, 1.0)
    return result


def ablation_bar(rows: Sequence[AblationRow], theme: Theme = LIGHT) -> Figure:
    """Return residual RMS of every model that was tried, in the fit and cross-validated; the chosen one is marked."""
    names = [f"▸ {row.name}" if row.is_chosen else row.name for row in rows]
    bars: list[tuple[str, str, list[float | None]]] = [
        ("in the fit", theme.series[5], [row.rms_nt for row in rows]),
        ("cross-validated", theme.before, [row.cross_validated_rms_nt for row in rows]),
    ]
    traces: list[Trace] = [
        {"type": "bar", "orientation": "h", "y": names, "x": values, "name": label}
        | {"marker": {"color": colour}, "hovertemplate": "%{x:.1f} nT"}
        for label, colour, values in bars
    ]
    layout: Layout = {
        "height": 120 + 44 * max(len(rows), 2),
        "barmode": "group",
        "xaxis": axis(theme, "residual RMS, nT", rangemode="tozero"),
        "yaxis": axis(theme, autorange="reversed"),
    }
    return make_figure(traces, theme, layout)


def compare_sets(first: ParameterSetRecord, second: ParameterSetRecord, theme: Theme = LIGHT) -> Figure:
    """Return the difference second - first of each parameter in its own combined honest standard errors."""
    values = [parameter_values(record["parameters"]) for record in (first, second)]
    errors = [parameter_values(record["standard_errors"]) for record in (first, second)]
    common = [name for name in first["parameter_names"] if name in values[1]]
    combined = np.array([np.hypot(errors[0].get(name, 0.0), errors[1].get(name, 0.0)) for name in common])
    difference = np.array([values[1][name] - values[0][name] for name in common])
    in_errors = np.divide(difference, combined, out=np.full(len(common), np.nan), where=combined > 0)
    trace: Trace = {
        "type": "bar",
        "x": [short_name(name) for name in common],
        "y": in_errors,
        "marker": {"color": [theme.before if abs(value) > 3 else theme.after for value in in_errors]},
        "hovertemplate": "%{x}: %{y:.1f} standard errors<extra></extra>",
    }
    layout: Layout = {
        "height": 300,
        "xaxis": axis(theme),
        "yaxis": axis(theme, "difference, standard errors", zerolinecolor=theme.muted),
        "shapes": [
            {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": bound, "y1": bound}
            | {"line": {"color": theme.muted, "width": 1, "dash": "dot"}}
            for bound in (-3, 3)
        ],
    }
    return make_figure([trace], theme, layout)


def short_name(name: str) -> str:
    """Return a parameter's name as figures and tables write it: ``bias_nt[0]`` is ``b1``."""
    letters: Mapping[str, str] = {group: letter for group, _, letter in GROUPS}
    group, bracket, rest = name.partition("[")
    if not bracket:
        return "Δt" if group == "time_offset_s" else group
    number = int(rest.rstrip("]")) + 1
    if group in letters:
        return f"{letters[group]}{number}"
    return f"{group.removeprefix('regressors.')} {number}"


def _middle_ms(sets: Sequence[SetHistory]) -> Floats:
    ends = [[record["data_from"].rstrip("Z"), record["data_until"].rstrip("Z")] for record in sets]
    times = np.array(ends, dtype="datetime64[ns]").reshape(-1, 2)
    middle: Floats = milliseconds(times).mean(axis=1)
    return middle


def _by_grade(sets: Sequence[SetHistory], y: Floats, theme: Theme) -> list[Trace]:
    """Return marks of ``y``, shape (n,), in the middle of each set's data, one trace a verdict."""
    x, grades = _middle_ms(sets), _grades(sets)
    return [
        scatter(
            x[is_so],
            y[is_so],
            "markers",
            name=grade,
            marker={"size": 8, "color": theme.grades[grade]} | {"symbol": symbol},
        )
        for grade, symbol in GRADE_SYMBOLS.items()
        if (is_so := grades == grade).any()
    ]


def _grades(sets: Sequence[SetHistory]) -> NDArray[np.str_]:
    return np.array([record["verdict"]["grade"] for record in sets], dtype=np.str_)


def _of_group(parameters: ParametersRecord, group: str) -> list[float | None]:
    if group == "bias_nt":
        return parameters["bias_nt"]
    return parameters["scale"] if group == "scale" else parameters["nonorthogonality_deg"]


def _history_traces(sets: Sequence[SetHistory], group: str, i: int, theme: Theme) -> list[Trace]:
    """Return one parameter's history: bars and a mark for each set, or a band and marks for the doubtful ones."""
    values, honest, formal = (
        np.array([_of_group(one, group)[i] for one in kind], dtype=np.float64)
        for kind in (
            [record["parameters"] for record in sets],
            [record["standard_errors"] for record in sets],
            [record["formal_standard_errors"] for record in sets],
        )
    )
    colour = theme.series[i]
    hover = "%{y:.6~g} ± %{customdata[0]:.3~g} (formal %{customdata[1]:.3~g})"
    line = {"color": colour, "width": 1}
    grades = _grades(sets)
    shown: Trace = {"customdata": np.column_stack([honest, formal]), "hovertemplate": hover, "line": line}
    if len(sets) <= MOST_BARS:
        bars = {"type": "data", "array": honest, "thickness": 1.2, "width": 3, "color": colour}
        marks = {"size": 7, "color": colour, "symbol": [GRADE_SYMBOLS.get(grade, "circle") for grade in grades]}
        return [scatter(None, values, "lines+markers", error_y=bars, marker=marks) | shown]
    edge = {"width": 0, "color": colour}
    doubts: list[Trace] = [
        scatter(
            None,
            np.where(grades == grade, values, np.nan),
            "markers",
            marker={"size": 6, "color": colour, "symbol": symbol},
        )
        for grade, symbol in GRADE_SYMBOLS.items()
        if grade != "accept" and (grades == grade).any()
    ]
    return [
        scatter(None, values - honest, line=edge, hoverinfo="skip"),
        scatter(None, values + honest, line=edge, hoverinfo="skip", fill="tonexty", fillcolor=f"{colour}40"),
        scatter(None, values) | shown,
        *(doubt | {"hoverinfo": "skip"} for doubt in doubts),
    ]
