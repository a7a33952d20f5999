"""How every figure looks: colours that colour-blind people tell apart, light and dark, and how traces are thinned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.numerics.time_series import extreme_indices, gap_after

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MAX_POINTS: Final = 5000
"""Points that one trace has at most; more is thinned with every extreme kept."""
FONT: Final = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif"


Trace = dict[str, object]
Layout = dict[str, object]


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours of one appearance; the roles are the same in all of them (Okabe and Ito's palette)."""

    name: str
    ink: str
    muted: str
    grid: str
    surface: str
    before: str
    after: str
    model: str
    series: tuple[str, str, str, str, str, str]
    grades: Mapping[str, str]
    diverging: Sequence[tuple[float, str]]
    zero: str
    sequential: Sequence[tuple[float, str]]


LIGHT: Final = Theme(
    name="light",
    ink="#1b1f24",
    muted="#57606a",
    grid="#e3e7ec",
    surface="#ffffff",
    before="#d55e00",
    after="#0072b2",
    model="#1b1f24",
    series=("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9"),
    grades={"accept": "#00795a", "weak": "#9a6700", "refuse": "#b3261e"},
    diverging=((0.0, "#08519c"), (0.25, "#6baed6"), (0.5, "#f2f2f2"), (0.75, "#fd8d3c"), (1.0, "#a63603")),
    zero="#a8aeb5",
    sequential=((0.0, "#00224e"), (0.25, "#414d6b"), (0.5, "#7c7b78"), (0.75, "#bcaf6f"), (1.0, "#fee838")),
)
DARK: Final = Theme(
    name="dark",
    ink="#e6eaef",
    muted="#a3adb8",
    grid="#2c343d",
    surface="#161b21",
    before="#f0883e",
    after="#56b4e9",
    model="#e6eaef",
    series=("#56b4e9", "#f0883e", "#2fc79a", "#e59cc4", "#e5c453", "#8fa8ff"),
    grades={"accept": "#3fc79a", "weak": "#e5b53a", "refuse": "#ff7b72"},
    diverging=((0.0, "#6bb4f0"), (0.25, "#2b6aa3"), (0.5, "#30363d"), (0.75, "#ab4f16"), (1.0, "#ffab70")),
    zero="#56606b",
    sequential=((0.0, "#1d3a6b"), (0.25, "#565f80"), (0.5, "#8c8a85"), (0.75, "#c8ba72"), (1.0, "#fee838")),
)
THEMES: Final[Mapping[str, Theme]] = {"light": LIGHT, "dark": DARK}

GRADE_SYMBOLS: Final[Mapping[str, str]] = {"accept": "circle", "weak": "diamond", "refuse": "x"}
"""Verdicts differ in shape as well as in colour."""


def axis(theme: Theme, title: str = "", **more: object) -> Layout:
    """Return an axis in the look of ``theme`` with ``title``, unit included, and whatever else plotly knows of axes."""
    look: Layout = {
        "title": {"text": title, "font": {"size": 12}, "standoff": 6},
        "gridcolor": theme.grid,
        "linecolor": theme.muted,
        "zerolinecolor": theme.grid,
        "tickcolor": theme.muted,
        "ticks": "outside",
        "ticklen": 4,
        "automargin": True,
        "exponentformat": "none",
    }
    return look | more


def scatter(x: object, y: object, draw: str = "lines", /, **more: object) -> Trace:
    """Return an SVG scatter trace of ``x`` and ``y`` that draws ``lines``, ``markers`` or both."""
    return {"type": "scatter", "mode": draw, "x": x, "y": y} | more


def make_figure(traces: Sequence[Trace], theme: Theme, layout: Layout) -> Figure:
    """Return a checked plotly figure of ``traces`` in the look of ``theme``.

    Notes
    -----
    plotly is imported here and nowhere else: it costs a tenth of a second that pages without a figure need not pay.
    """
    import plotly.graph_objects as go

    base: Layout = {
        "template": {},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": FONT, "size": 12, "color": theme.ink},
        "colorway": list(theme.series),
        "margin": {"l": 64, "r": 16, "t": 28, "b": 44},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "bgcolor": "rgba(0,0,0,0)"},
        "hoverlabel": {"bgcolor": theme.surface, "bordercolor": theme.muted, "font": {"color": theme.ink}},
        "hovermode": "closest",
        "height": 360,
    }
    return go.Figure(data=list(traces), layout=base | layout)


def milliseconds(t_utc: Times) -> Floats:
    """Return times as plotly's date axes take them in numbers: ms since 1970-01-01 UTC, shape (n,)."""
    return (t_utc - np.datetime64(0, "ns")) / np.timedelta64(1, "ms")


def time_line(t_utc: Times, y: Floats, limit: int = MAX_POINTS) -> tuple[Floats, Floats]:
    """Return x, ms, and y of a line in time, at most ``limit`` points and every extreme kept; lines break at gaps."""
    breaks = gap_after(t_utc)
    room = max(limit - breaks.size, limit // 2)
    chosen = extreme_indices(y, room)
    x, shown = milliseconds(t_utc[chosen]), y[chosen].astype(np.float64)
    if 0 < breaks.size <= limit - room:
        at = np.searchsorted(chosen, breaks, side="right")
        x, shown = np.insert(x, at, milliseconds(t_utc[breaks]) + 1.0), np.insert(shown, at, np.nan)
    return x, shown


def time_axis(theme: Theme, t_utc: Times, title: str = "UTC", **more: object) -> Layout:
    """Return a date axis that leaves out what lies between sessions: gaps longer than a tenth of the measured time."""
    found = axis(theme, title, type="date", **more)
    if len(t_utc) < 2:
        return found
    steps_ms = np.diff(milliseconds(t_utc))
    breaks = gap_after(t_utc)
    measured_ms = float(steps_ms.sum() - steps_ms[breaks].sum())
    longest = breaks[np.argsort(steps_ms[breaks])[::-1][:20]]
    cut = np.sort(longest[steps_ms[longest] > 0.1 * measured_ms])
    if cut.size == 0:
        return found
    margin_ms = 0.01 * measured_ms
    bounds = [[_date(t_utc[i], margin_ms), _date(t_utc[i + 1], -margin_ms)] for i in cut]
    starts = t_utc[np.concatenate([[0], cut + 1])]
    ticks: Layout = {
        "rangebreaks": [{"bounds": pair} for pair in bounds],
        "tickvals": milliseconds(starts),
        "ticktext": [f"{text[:10]}<br>{text[11:16]}" for text in np.datetime_as_string(starts, unit="s")],
    }
    return found | ticks


def _date(t_utc: np.datetime64, shift_ms: float) -> str:
    shifted = t_utc + np.timedelta64(int(shift_ms * 1e6), "ns")
    return str(np.datetime_as_string(shifted, unit="ms")).replace("T", " ")
