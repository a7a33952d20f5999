"""Figures of a session before any calibration: its readings, its coverage of the body sphere, its housekeeping."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from app.reporting.figures.residuals import hemispheres
from app.reporting.figures.style import (
    LIGHT,
    MAX_POINTS,
    Layout,
    Theme,
    Trace,
    axis,
    make_figure,
    milliseconds,
    scatter,
    time_axis,
    time_line,
)
from magcal_core.arrays import Floats
from magcal_core.numerics.sphere import equal_area_disc
from magcal_core.numerics.time_series import extreme_indices
from magcal_core.samples import Samples

if TYPE_CHECKING:
    from plotly.graph_objects import Figure


def raw_field(samples: Samples, theme: Theme = LIGHT) -> Figure:
    """Return |B| as measured and its components against time, flagged samples marked."""
    magnitude = np.linalg.norm(samples.h_nt, axis=1)
    columns = [("|B| measured", magnitude, theme.ink, 2.0)]
    columns += [(f"b{axis_}", samples.h_nt[:, i], theme.series[i], 1.0) for i, axis_ in enumerate("xyz")]
    traces: list[Trace] = []
    for name, column, colour, width in columns:
        x, y = time_line(samples.t_utc, np.where(samples.is_used, column, np.nan))
        look: Trace = {"line": {"color": colour, "width": width}, "hovertemplate": "%{y:.0f} nT"}
        traces.append(scatter(x, y, name=name) | look)
    flagged = np.flatnonzero((samples.flags > 0) & np.isfinite(magnitude))
    if flagged.size:
        flagged = flagged[extreme_indices(magnitude[flagged], MAX_POINTS)]
        cross = {"symbol": "x-thin-open", "size": 7, "color": theme.before}
        x, y = milliseconds(samples.t_utc[flagged]), magnitude[flagged]
        traces.append(scatter(x, y, "markers", name="flagged", marker=cross))
    layout: Layout = {
        "hovermode": "x",
        "xaxis": time_axis(theme, samples.t_utc),
        "yaxis": axis(theme, "nT", tickformat="d"),
    }
    return make_figure(traces, theme, layout)


def sphere_coverage(b_body_nt: Floats, theme: Theme = LIGHT) -> Figure:
    """Return where on the body sphere the field was seen: directions of vectors of shape (n, 3), equal area."""
    index = np.flatnonzero(np.isfinite(b_body_nt).all(axis=1) & (np.abs(b_body_nt).sum(axis=1) > 0))
    if index.size > MAX_POINTS:
        index = index[np.linspace(0, index.size - 1, MAX_POINTS).astype(np.intp)]
    x, y, is_upper = equal_area_disc(b_body_nt[index])
    dot = {"size": 4, "color": theme.after, "opacity": 0.6}
    traces: list[Trace] = [
        scatter(x[side], y[side], "markers", xaxis=name, hoverinfo="skip", marker=dot)
        for side, name in ((is_upper, "x"), (~is_upper, "x2"))
    ]
    return make_figure(traces, theme, hemispheres(theme))


def housekeeping(samples: Samples, theme: Theme = LIGHT) -> Figure:
    """Return every housekeeping column against time, each with an axis of its own, one below the other."""
    names = list(samples.housekeeping)
    traces: list[Trace] = []
    layout: Layout = {"height": 80 + 130 * max(len(names), 1), "showlegend": False}
    for row, name in enumerate(names):
        suffix = "" if row == 0 else str(row + 1)
        x, y = time_line(samples.t_utc, samples.housekeeping[name])
        line = {"color": theme.series[row % len(theme.series)], "width": 1.5}
        traces.append(scatter(x, y, name=name, yaxis=f"y{suffix}", line=line))
        top = 1.0 - row / len(names)
        layout[f"yaxis{suffix}"] = axis(theme, name, domain=[top - 0.82 / len(names), top])
    bottom = "y" if len(names) < 2 else f"y{len(names)}"
    layout["xaxis"] = time_axis(theme, samples.t_utc, anchor=bottom)
    return make_figure(traces, theme, layout)
