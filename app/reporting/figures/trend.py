"""Figures of parameters in time: the trend over sets with the life of the active one, the path of a session's bias."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from app.reporting.figures.parameters import GROUPS
from app.reporting.figures.style import LIGHT, Layout, Theme, Trace, axis, make_figure, milliseconds, scatter
from magcal_core.arrays import Floats, Times

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

    from magcal_core.calibration.sessions.trend import Trend
    from magcal_core.calibration.sessions.trend_sets import DatedSet
    from magcal_core.calibration.sessions.trend_states import TrendStates
    from magcal_core.calibration.terms.bias_path import BiasPath

NORMAL: Final = 1.96
"""Standard errors of a 95 % interval."""
_LINE_POINTS: Final = 240
_LETTERS: Final = "xyz"
_TOP: Final = 0.33
"""Height of the panel of the bound, as a share of the figure's, with its title."""
_PANEL: Final = 0.16
_STEP: Final = 0.235


def trend_figure(trend: Trend, theme: Theme = LIGHT) -> Figure:
    """Return nine panels of parameters over time and, below, the bound of the active set's field error.

    A point with its 95 % bar for each set, hollow where it is left out; the smoothed line with its 95 % band up to the
    time asked for and on to the end of the life; jumps as hatched intervals.
    """
    bounds, times = _bounds(trend)
    states = trend.smoothed.at(_line_times(trend, times[-1]))
    traces: list[Trace] = []
    notes: list[Layout] = []
    layout: Layout = {"height": 860, "showlegend": False}
    for row, (group, title, letter) in enumerate(GROUPS):
        for i in range(3):
            place = 3 * row + i
            name = "" if place == 0 else str(place + 1)
            left, top = 0.35 * i, 1.0 - _STEP * row
            times_axis = axis(theme, type="date", domain=[left, left + 0.28], anchor=f"y{name}", nticks=4)
            layout[f"xaxis{name}"] = times_axis if place == 0 else times_axis | {"matches": "x"}
            layout[f"yaxis{name}"] = axis(theme, domain=[top - _PANEL, top], anchor=f"x{name}", nticks=5)
            unit = "" if group == "scale" else f", {title.split(', ')[1]}"
            notes.append(_heading(f"<b>{letter}{i + 1}</b>{unit}", left, top))
            on: Trace = {"xaxis": f"x{name}", "yaxis": f"y{name}", "name": f"{letter}{i + 1}"}
            found = [*_band(states, place, theme), *_marks(trend, place, theme)]
            found += [
                _hatched(jump.begin, jump.end, found, f"jump: {jump.text}", theme)
                for jump in trend.jumps
                if jump.group == group
            ]
            traces += [trace | on for trace in found]
    traces += _bound_traces(trend, times, bounds, theme)
    layout["xaxis10"] = axis(theme, "UTC", type="date", domain=[0.0, 1.0], anchor="y10")
    layout["yaxis10"] = axis(
        theme, "error of the field, nT", domain=[0.0, _TOP - 0.09], anchor="x10", rangemode="tozero"
    )
    notes.append(_heading(f"<b>{trend.life().text}</b>", 0.0, _TOP - 0.09))
    return make_figure(traces, theme, layout | {"annotations": notes})


def _bounds(trend: Trend) -> tuple[Floats, Times]:
    """Return the bound of the active set's field error, nT, and when it is read off, UTC.

    The line goes on a little past the end of the life, and where there is none to the end of what may be said.
    """
    begin, years, bounds = trend.bounds(trend.chosen.active.parameters)
    days = trend.life().days
    shown = len(years) if days is None else min(len(years), int(np.searchsorted(years, days / 365.25)) + 12)
    first = trend.smoothed.time_of(begin)
    steps = (years[:shown] * 365.25 * 86400e9).astype(np.int64).astype("timedelta64[ns]")
    return bounds[:shown], first + steps


def _line_times(trend: Trend, end: np.datetime64) -> Times:
    """Return the times of the smoothed line: evenly, and on both sides of every set, where it bends."""
    own = np.array([one.time_ns for one in trend.sets], np.int64)
    even = np.linspace(float(own[0]), float(end.astype(np.int64)), _LINE_POINTS).astype(np.int64)
    jumps = [(int(jump.begin.astype(np.int64)) + int(jump.end.astype(np.int64))) // 2 for jump in trend.jumps]
    sides = np.array([side for middle in jumps for side in (middle - 1, middle + 1)], np.int64)
    return np.unique(np.concatenate([even, own, sides])).astype("datetime64[ns]")


def _heading(text: str, x: float, y: float) -> Layout:
    place: Layout = {"text": text, "xref": "paper", "yref": "paper", "x": x, "y": y + 0.008}
    return place | {"xanchor": "left", "yanchor": "bottom", "showarrow": False}


def _band(states: TrendStates, place: int, theme: Theme) -> list[Trace]:
    x, y = milliseconds(states.t_utc), states.parameters[:, place]
    reach = NORMAL * states.standard_errors[:, place]
    edge = {"width": 0, "color": theme.after}
    return [
        scatter(x, y - reach, line=edge, hoverinfo="skip"),
        scatter(x, y + reach, line=edge, hoverinfo="skip", fill="tonexty", fillcolor=f"{theme.after}33"),
        scatter(x, y, line={"color": theme.after, "width": 1.5}, hovertemplate="%{y:.6~g}"),
    ]


def _marks(trend: Trend, place: int, theme: Theme) -> list[Trace]:
    """Return the sets: those that count filled, the others hollow with their reason."""
    reasons = dict(trend.left_out)
    counted = [one for one in trend.chosen.every if one.label not in reasons]
    others = [one for one in trend.chosen.every if one.label in reasons and one.covariance is not None]
    found = [_points(counted, place, theme.ink, "circle", [one.label for one in counted])]
    if others:
        texts = [f"{one.label}, left out: {reasons[one.label]}" for one in others]
        found.append(_points(others, place, theme.muted, "circle-open", texts))
    return found


def _points(sets: Sequence[DatedSet], place: int, colour: str, symbol: str, texts: Sequence[str]) -> Trace:
    x = milliseconds(np.array([one.time_ns for one in sets], np.int64).astype("datetime64[ns]"))
    errors = [0.0 if one.covariance is None else NORMAL * float(np.sqrt(one.covariance[place, place])) for one in sets]
    return scatter(
        x,
        np.array([one.parameters[place] for one in sets]),
        "markers",
        text=list(texts),
        hovertemplate="%{text}: %{y:.6~g}",
        error_y={"type": "data", "array": errors, "thickness": 1.1, "width": 2, "color": colour},
        marker={"size": 6, "color": colour, "symbol": symbol},
    )


def _bound_traces(trend: Trend, times: Times, bounds: Floats, theme: Theme) -> list[Trace]:
    limit_nt = trend.share * trend.field_nt
    x = milliseconds(times)
    on: Trace = {"xaxis": "x10", "yaxis": "y10"}
    line = scatter(x, bounds, line={"color": theme.after, "width": 2}, name="bound, 95 %", hovertemplate="%{y:.0f} nT")
    limit = scatter(
        x[[0, -1]],
        np.array([limit_nt, limit_nt]),
        line={"color": theme.before, "width": 1.5, "dash": "dash"},
        name="limit",
        hovertemplate=f"limit {100 * trend.share:.3g} % of {trend.field_nt:,.0f} nT",
    )
    return [line | on, limit | on]


def _hatched(begin: np.datetime64, end: np.datetime64, traces: Sequence[Trace], text: str, theme: Theme) -> Trace:
    """Return a hatched interval as high as what ``traces`` show."""
    drawn = np.concatenate([np.asarray(trace["y"], np.float64) for trace in traces])
    low, high = float(np.nanmin(drawn)), float(np.nanmax(drawn))
    first, last = milliseconds(np.array([begin, end]).astype("datetime64[ns]"))
    return scatter(
        np.array([first, last, last, first, first]),
        np.array([low, low, high, high, low]),
        "lines",
        fill="toself",
        fillcolor=f"{theme.before}1a",
        fillpattern={"shape": "/", "fgcolor": theme.before, "size": 6, "solidity": 0.2},
        line={"color": theme.before, "width": 1, "dash": "dot"},
        text=text,
        hoverinfo="text",
    )


def bias_path_figure(path: BiasPath, theme: Theme = LIGHT, errors_nt: Sequence[float | None] | None = None) -> Figure:
    """Return three panels of the bias against time with its 95 % band, steps as bands, the set's own value beside.

    ``errors_nt``: honest standard errors of the set's bias; those of its fit unless given.
    """
    x = milliseconds(path.t_utc)
    own_errors = [*path.own_errors_nt] if errors_nt is None else [one or 0.0 for one in errors_nt]
    traces: list[Trace] = []
    layout: Layout = {"height": 560, "showlegend": False}
    for i, letter in enumerate(_LETTERS):
        name = "" if i == 0 else str(i + 1)
        top = 1.0 - 0.345 * i
        times = axis(theme, "UTC" if i == 2 else "", type="date", anchor=f"y{name}")
        layout[f"xaxis{name}"] = times if i == 0 else times | {"matches": "x"}
        layout[f"yaxis{name}"] = axis(theme, f"bias {letter}, nT", domain=[top - 0.28, top], anchor=f"x{name}")
        on: Trace = {"xaxis": f"x{name}", "yaxis": f"y{name}", "name": f"bias {letter}"}
        found = _path_traces(path, i, x, own_errors[i], theme)
        block = np.median(np.diff(path.t_utc)) if len(path.t_utc) > 1 else np.timedelta64(0, "ns")
        found += [_hatched(step.begin - block, step.end + block, found, step.text, theme) for step in path.steps]
        traces += [trace | on for trace in found]
    return make_figure(traces, theme, layout)


def _path_traces(path: BiasPath, i: int, x: Floats, own_error_nt: float, theme: Theme) -> list[Trace]:
    value, reach = path.bias_nt[:, i], NORMAL * path.standard_errors_nt[:, i]
    edge = {"width": 0, "color": theme.after}
    own = float(path.own_bias_nt[i])
    ends = x[[0, -1]]
    bar = {"type": "data", "array": [NORMAL * own_error_nt], "thickness": 1.2, "width": 4, "color": theme.before}
    return [
        scatter(x, value - reach, line=edge, hoverinfo="skip"),
        scatter(x, value + reach, line=edge, hoverinfo="skip", fill="tonexty", fillcolor=f"{theme.after}33"),
        scatter(x, value, line={"color": theme.after, "width": 1.5}, hovertemplate="%{y:.1f} nT"),
        scatter(ends, np.array([own, own]), line={"color": theme.before, "width": 1, "dash": "dash"}, hoverinfo="skip"),
        scatter(
            ends[-1:],
            np.array([own]),
            "markers",
            error_y=bar,
            marker={"size": 7, "color": theme.before},
            hovertemplate="the set's own: %{y:.1f} nT",
        ),
    ]
