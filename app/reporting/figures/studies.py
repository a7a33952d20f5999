"""Figures of the attitude simulation and of the energy balance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from app.reporting.figures.style import LIGHT, Layout, Theme, Trace, axis, make_figure, scatter, time_axis, time_line
from magcal_core.arrays import Floats, Times
from magcal_core.numerics.time_series import extreme_indices

if TYPE_CHECKING:
    from plotly.graph_objects import Figure


def settling(time_s: Floats, error_deg: Mapping[str, Floats], theme: Theme = LIGHT) -> Figure:
    """Return the total attitude error, deg, of each named run against time, with the levels 10, 5 and 1 deg (ROM)."""
    traces: list[Trace] = []
    for (name, error), colour in zip(error_deg.items(), theme.series, strict=False):
        index = extreme_indices(error, 5000)
        look: Trace = {"line": {"color": colour, "width": 2}, "hovertemplate": "%{x:.2f} h: %{y:.3g} deg"}
        traces.append(scatter(time_s[index] / 3600.0, error[index], name=name) | look)
    levels = [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": level, "y1": level}
        | {"line": {"color": theme.muted, "width": 1, "dash": "dot"}}
        for level in (10.0, 5.0, 1.0)
    ]
    layout: Layout = {
        "shapes": levels,
        "xaxis": axis(theme, "time, h", rangemode="tozero"),
        "yaxis": axis(theme, "attitude error, deg", type="log", dtick=1, exponentformat="power"),
    }
    return make_figure(traces, theme, layout)


def error_against_angle(angle_arcmin: Floats, error_arcmin: Mapping[str, Floats], theme: Theme = LIGHT) -> Figure:
    """Return the steady attitude error against the sensor's non-orthogonality, both in arcmin (ROM, figure 4)."""
    traces: list[Trace] = [
        scatter(angle_arcmin, error, "lines+markers", name=name, line={"color": colour, "width": 2})
        for (name, error), colour in zip(error_arcmin.items(), theme.series, strict=False)
    ]
    layout: Layout = {
        "xaxis": axis(theme, "non-orthogonality, arcmin", rangemode="tozero"),
        "yaxis": axis(theme, "largest error of the last two orbits, arcmin", rangemode="tozero"),
    }
    return make_figure(traces, theme, layout)


def energy_terms(t_utc: Times, terms_m2_s2: Mapping[str, Floats], theme: Theme = LIGHT) -> Figure:
    """Return each term of the energy balance less its mean, m2/s2, one below the other (ENERGY)."""
    names = list(terms_m2_s2)
    traces: list[Trace] = []
    layout: Layout = {"height": 80 + 120 * max(len(names), 1), "showlegend": False}
    for row, name in enumerate(names):
        suffix = "" if row == 0 else str(row + 1)
        x, y = time_line(t_utc, terms_m2_s2[name] - np.nanmean(terms_m2_s2[name]))
        look: Trace = {"line": {"color": theme.after, "width": 1.2}, "hovertemplate": "%{y:.4g} m²/s²"}
        traces.append(scatter(x, y, name=name, yaxis=f"y{suffix}") | look)
        top = 1.0 - row / len(names)
        layout[f"yaxis{suffix}"] = axis(
            theme, name, domain=[top - 0.78 / len(names), top], exponentformat="power", nticks=4
        )
    layout["xaxis"] = time_axis(theme, t_utc, anchor="y" if len(names) < 2 else f"y{len(names)}")
    return make_figure(traces, theme, layout)


def coefficient_errors(
    degree: Floats, signal_rms: Floats, error_rms: Mapping[str, Floats], theme: Theme = LIGHT
) -> Figure:
    """Return the signal of the gravity field and the errors of recovered coefficients by degree (ENERGY)."""
    curves = {"signal": signal_rms} | dict(error_rms)
    colours = (theme.ink, *theme.series)
    traces: list[Trace] = [
        scatter(degree, values, "lines+markers", name=name, line={"color": colour, "width": 2})
        for (name, values), colour in zip(curves.items(), colours, strict=False)
    ]
    layout: Layout = {
        "xaxis": axis(theme, "degree", dtick=1),
        "yaxis": axis(theme, "RMS of a coefficient", type="log", exponentformat="power", dtick=1),
    }
    return make_figure(traces, theme, layout)
