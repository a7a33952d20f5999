"""Figures of one calibration's residuals: before and after, in time, as a distribution, on sphere and Earth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from app.reporting.figures.coastlines import coastlines
from app.reporting.figures.isolines import field_lines
from app.reporting.figures.style import (
    LIGHT,
    MAX_POINTS,
    Layout,
    Theme,
    Trace,
    axis,
    make_figure,
    milliseconds,
    time_axis,
    time_line,
)
from magcal_core.arrays import Floats, Times
from magcal_core.calibration.residuals import ResidualTable
from magcal_core.numerics.sphere import equal_area_disc, latitude_longitude_deg
from magcal_core.numerics.time_series import autocorrelation, extreme_indices

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

COMPONENTS: Final = ("x", "y", "z")
NT: Final = "%{y:.1f} nT"


@dataclass(frozen=True, slots=True, eq=False)
class IndexSeries:
    """The hourly index of the external field about a session: middles of hours, UTC, and values, nT."""

    name: str
    t_utc: Times
    index_nt: Floats

    @classmethod
    def of_record(cls, record: Mapping[str, object]) -> IndexSeries | None:
        """Return the series that a parameter set keeps; None where it has none."""
        found = record.get("external_index")
        if not isinstance(found, Mapping):
            return None
        times = np.array([str(time).removesuffix("Z") for time in found["time"]], "datetime64[ns]")
        return cls(str(found["name"]), times, np.array(found["index_nt"], np.float64))


def before_after(table: ResidualTable, theme: Theme = LIGHT) -> Figure:
    """Return |B| against the model twice, above as measured and below as corrected (DEKART, figures 1-4)."""
    traces = [
        _line(table.t_utc, table.raw_nt, "|B| measured", theme.before, "y"),
        _line(table.t_utc, table.model_nt, "|B| model", theme.model, "y", dash="dot"),
        _line(table.t_utc, table.corrected_nt, "|B| corrected", theme.after, "y2"),
        _line(table.t_utc, table.model_nt, "|B| model", theme.model, "y2", dash="dot") | {"showlegend": False},
    ]
    shown = np.concatenate([table.raw_nt, table.model_nt, table.corrected_nt])
    shown = shown[np.isfinite(shown)]
    span = [float(shown.min()), float(shown.max())] if shown.size else [0.0, 1.0]
    margin = 0.05 * (span[1] - span[0])
    reach = [span[0] - margin, span[1] + margin]
    layout: Layout = {
        "height": 520,
        "hovermode": "x",
        "xaxis": time_axis(theme, table.t_utc, anchor="y2"),
        "yaxis": axis(theme, "before: |B|, nT", domain=[0.54, 1.0], range=reach, tickformat="d"),
        "yaxis2": axis(theme, "after: |B|, nT", domain=[0.0, 0.46], range=reach, tickformat="d"),
    }
    return make_figure(traces, theme, layout)


def residual_time(table: ResidualTable, theme: Theme = LIGHT, index: IndexSeries | None = None) -> Figure:
    """Return the residual against time, with the samples that the fit left out marked.

    ``index``: the index of the external field over the session, which is drawn as a strip below.
    """
    is_out = (table.weight <= 0) & np.isfinite(_worst(table))
    used = [np.where(is_out, np.nan, column) for column in _columns(table)]
    traces = [
        _line(table.t_utc, column, name, colour, "y")
        for (name, colour), column in zip(_labels(table, theme), used, strict=True)
    ]
    if is_out.any():
        rows = np.flatnonzero(is_out)
        rows = rows[extreme_indices(_worst(table)[rows], MAX_POINTS)]
        crosses: Trace = {
            "type": "scatter",
            "mode": "markers",
            "name": "left out",
            "x": milliseconds(table.t_utc[rows]),
            "y": _worst(table)[rows],
            "marker": {"symbol": "x-thin-open", "color": theme.before, "size": 7},
            "hovertemplate": NT,
        }
        traces.append(crosses)
    layout: Layout = {
        "xaxis": time_axis(theme, table.t_utc),
        "yaxis": axis(theme, "residual, nT", tickformat="d", zerolinecolor=theme.muted),
    }
    if index is not None:
        traces.append(_strip(index, theme))
        layout["xaxis"] = time_axis(theme, table.t_utc, anchor="y2")
        layout["yaxis"] = axis(theme, "residual, nT", tickformat="d", zerolinecolor=theme.muted, domain=[0.3, 1.0])
        layout["yaxis2"] = axis(theme, f"{index.name}, nT", domain=[0.0, 0.2], tickformat="d")
    return make_figure(traces, theme, layout)


def _strip(index: IndexSeries, theme: Theme) -> Trace:
    """Return the index as a line through the middles of hours, on the axis below."""
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": index.name,
        "x": milliseconds(index.t_utc),
        "y": index.index_nt,
        "yaxis": "y2",
        "line": {"color": theme.model, "width": 1.5},
        "marker": {"size": 4},
        "hovertemplate": NT,
    }


def residual_histogram(table: ResidualTable, theme: Theme = LIGHT, bins: int = 60) -> Figure:
    """Return the distribution of the residuals in the fit beside the normal one of the same mean and spread."""
    known = np.concatenate([column[(table.weight > 0) & np.isfinite(column)] for column in _columns(table)])
    if known.size < 2:
        return make_figure([], theme, {"xaxis": axis(theme, "residual, nT"), "yaxis": axis(theme, "samples")})
    reach = float(np.abs(np.quantile(known, [0.001, 0.999])).max()) * 1.05 or 1.0
    edges = np.linspace(-reach, reach, bins + 1)
    count, _ = np.histogram(known, edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    mean, spread = float(known.mean()), float(known.std())
    normal = known.size * (edges[1] - edges[0]) * np.exp(-0.5 * ((middle - mean) / spread) ** 2)
    normal /= spread * np.sqrt(2 * np.pi)
    traces: list[Trace] = [
        {
            "type": "bar",
            "x": middle,
            "y": count.astype(np.float64),
            "name": "residuals in the fit",
            "marker": {"color": theme.after, "line": {"width": 0}},
            "hovertemplate": "%{x:.1f} nT: %{y:d}",
        },
        {
            "type": "scatter",
            "mode": "lines",
            "x": middle,
            "y": normal,
            "name": f"normal, {mean:.1f} ± {spread:.1f} nT",
            "line": {"color": theme.before, "width": 2, "dash": "dash"},
        },
    ]
    layout: Layout = {
        "bargap": 0.02,
        "xaxis": axis(theme, "residual, nT"),
        "yaxis": axis(theme, "samples"),
    }
    return make_figure(traces, theme, layout)


def residual_autocorrelation(table: ResidualTable, theme: Theme = LIGHT, max_lag: int = 400) -> Figure:
    """Return the residuals' autocorrelation by lag with the band in which white noise would stay (95 %)."""
    traces: list[Trace] = []
    band = 0.0
    for (name, colour), column in zip(_labels(table, theme), _columns(table), strict=True):
        in_fit = np.where(table.weight > 0, column, np.nan)
        known = int(np.isfinite(in_fit).sum())
        lag_s, r = autocorrelation(table.t_utc, in_fit, min(max_lag, max(known // 3, 1)))
        band = 1.96 / np.sqrt(known) if known else 0.0
        trace: Trace = {"type": "scatter", "mode": "lines", "x": lag_s / 60.0, "y": r, "name": name}
        traces.append(trace | {"line": {"color": colour, "width": 2}, "hovertemplate": "%{x:.1f} min: %{y:.2f}"})
    layout: Layout = {
        "showlegend": len(traces) > 1,
        "xaxis": axis(theme, "lag, minutes", rangemode="tozero"),
        "yaxis": axis(theme, "autocorrelation", range=[-1.05, 1.05], zerolinecolor=theme.muted),
        "shapes": [_band(-band, band, theme)],
    }
    return make_figure(traces, theme, layout)


def residual_map(t_utc: Times, r_itrf_km: Floats, residual_nt: Floats, theme: Theme = LIGHT) -> Figure:
    """Return the residual, shape (n,), over geocentric latitude and longitude, with coastlines and lines of |B|."""
    index = np.flatnonzero(np.isfinite(residual_nt) & np.isfinite(r_itrf_km).all(axis=1))
    index = index[extreme_indices(residual_nt[index], MAX_POINTS)]
    latitude, longitude = latitude_longitude_deg(r_itrf_km[index])
    when = np.datetime_as_string(t_utc[index].astype("datetime64[s]"))
    trace = _coloured(longitude, latitude, residual_nt[index], theme) | {
        "text": when.tolist(),
        "hovertemplate": "%{text}<br>%{y:.1f}° N %{x:.1f}° E<br>%{marker.color:.1f} nT<extra></extra>",
    }
    layout: Layout = {
        "height": 420,
        "showlegend": False,
        "xaxis": axis(theme, "longitude, deg east", range=[-180, 180], dtick=60),
        "yaxis": axis(theme, "latitude, deg north", range=[-90, 90], dtick=30),
    }
    ground = [*field_lines(t_utc[index], r_itrf_km[index], theme), coastlines(theme)]
    return make_figure([*ground, trace], theme, layout)


def residual_sphere(b_body_nt: Floats, residual_nt: Floats, theme: Theme = LIGHT) -> Figure:
    """Return the residual, shape (n,), by the direction of the field in the sensor's base frame, shape (n, 3)."""
    index = np.flatnonzero(np.isfinite(residual_nt) & np.isfinite(b_body_nt).all(axis=1))
    index = index[extreme_indices(residual_nt[index], MAX_POINTS)]
    x, y, is_upper = equal_area_disc(b_body_nt[index])
    hover = "%{marker.color:.1f} nT<extra></extra>"
    scale = _colour_limit(residual_nt[index])
    traces = [
        _coloured(x[side], y[side], residual_nt[index][side], theme, limit=scale)
        | {"xaxis": axis_name, "hovertemplate": hover}
        for side, axis_name in ((is_upper, "x"), (~is_upper, "x2"))
    ]
    return make_figure(traces, theme, hemispheres(theme))


def hemispheres(theme: Theme) -> Layout:
    """Return the layout of two equal-area discs, +z left and -z right, each with its circle and its axes named."""
    bare = {"showgrid": False, "zeroline": False, "showticklabels": False, "ticks": "", "range": [-1.14, 1.14]}
    bare |= {"showline": False, "constrain": "domain", "title": {"text": ""}}
    circles = [
        {"type": "circle", "xref": name, "yref": "y", "x0": -s, "x1": s, "y0": -s, "y1": s}
        | {"line": {"color": theme.muted if s == 1.0 else theme.grid, "width": 1}, "layer": "below"}
        for name in ("x", "x2")
        for s in (1.0, np.sqrt(0.5))
    ]
    labels = [
        {"xref": name, "yref": "y", "x": x, "y": y, "text": text, "showarrow": False, "font": {"color": theme.muted}}
        for name, pole in (("x", "<b>+z</b>"), ("x2", "<b>−z</b>"))
        for x, y, text in ((-0.9, 0.9, pole), (1.06, 0, "+x"), (-1.06, 0, "−x"), (0, 1.06, "+y"), (0, -1.06, "−y"))
    ]
    return {
        "height": 400,
        "showlegend": False,
        "margin": {"l": 8, "r": 8, "t": 16, "b": 8},
        "xaxis": axis(theme, domain=[0.0, 0.47]) | bare,
        "xaxis2": axis(theme, domain=[0.53, 1.0], scaleanchor="y") | bare,
        "yaxis": axis(theme, scaleanchor="x") | bare,
        "shapes": circles,
        "annotations": labels,
    }


def _columns(table: ResidualTable) -> list[Floats]:
    if table.residual_nt.ndim == 1:
        return [table.residual_nt]
    return [table.residual_nt[:, i] for i in range(3)]


def _labels(table: ResidualTable, theme: Theme) -> list[tuple[str, str]]:
    if table.residual_nt.ndim == 1:
        return [("residual", theme.after)]
    return [(f"residual {name}", colour) for name, colour in zip(COMPONENTS, theme.series[:3], strict=True)]


def _worst(table: ResidualTable) -> Floats:
    columns = np.stack(_columns(table), axis=1)
    index = np.argmax(np.abs(np.nan_to_num(columns)), axis=1)
    worst: Floats = columns[np.arange(len(columns)), index]
    return worst


def _line(t_utc: Times, y: Floats, name: str, colour: str, yaxis: str, *, dash: str = "solid") -> Trace:
    x, shown = time_line(t_utc, y)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": x,
        "y": shown,
        "yaxis": yaxis,
        "line": {"color": colour, "width": 1.5, "dash": dash},
        "hovertemplate": NT,
    }


def _colour_limit(residual_nt: Floats) -> float:
    return float(np.quantile(np.abs(residual_nt), 0.99)) or 1.0 if residual_nt.size else 1.0


def _coloured(x: Floats, y: Floats, colour_nt: Floats, theme: Theme, limit: float | None = None) -> Trace:
    """Return points by their colour, symmetric about zero, those near zero grey: they are to be seen as well."""
    reach = _colour_limit(colour_nt) if limit is None else limit
    bar = {"title": {"text": "nT", "side": "top"}, "thickness": 12, "len": 0.8, "outlinewidth": 0}
    return {
        "type": "scatter",
        "mode": "markers",
        "x": x,
        "y": y,
        "marker": {
            "size": 5,
            "color": colour_nt,
            "cmin": -reach,
            "cmax": reach,
            "colorscale": [[at, theme.zero if at == 0.5 else colour] for at, colour in theme.diverging],
            "colorbar": bar,
        },
    }


def _band(low: float, high: float, theme: Theme) -> dict[str, object]:
    where = {"type": "rect", "xref": "paper", "x0": 0, "x1": 1, "y0": low, "y1": high, "layer": "below"}
    return where | {"fillcolor": theme.grid, "line": {"width": 0}}
