"""Figure of what happened: sessions by the verdict of their newest set, and which set was in force when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Final

from app.reporting.figures.style import GRADE_SYMBOLS, LIGHT, Layout, Theme, Trace, axis, make_figure, scatter

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

NO_GRADE: Final = "not calibrated"


@dataclass(frozen=True, slots=True)
class SessionMark:
    """One session: its data's span, its samples, and the verdict of its newest parameter set, if it has one."""

    data_from: datetime
    data_until: datetime
    samples: int
    grade: str | None


@dataclass(frozen=True, slots=True)
class InForce:
    """A span of time in which a parameter set was in force; ``end`` is the time of looking where it still is."""

    begin: datetime
    end: datetime
    name: str
    grade: str


def session_timeline(sessions: Sequence[SessionMark], in_force: Sequence[InForce], theme: Theme = LIGHT) -> Figure:
    """Return sessions over the time of their data, and below, over the time of operation, what was in force."""
    traces: list[Trace] = []
    for grade in (*GRADE_SYMBOLS, NO_GRADE):
        marks = [mark for mark in sessions if (mark.grade or NO_GRADE) == grade]
        if marks:
            traces.append(_session_trace(marks, grade, theme))
    for grade in GRADE_SYMBOLS:
        spans = [span for span in in_force if span.grade == grade]
        if spans:
            traces.append(_span_trace(spans, grade, theme))
    layout: Layout = {
        "height": 340,
        "barmode": "overlay",
        "xaxis": axis(theme, "UTC of the data", type="date", anchor="y"),
        "yaxis": axis(theme, "samples", domain=[0.58, 1.0], rangemode="tozero"),
        "xaxis2": axis(theme, "UTC of operation", type="date", anchor="y2"),
        "yaxis2": axis(theme, "in force", domain=[0.0, 0.2], showticklabels=False, ticks="", showgrid=False),
    }
    return make_figure(traces, theme, layout)


def _session_trace(marks: Sequence[SessionMark], grade: str, theme: Theme) -> Trace:
    return scatter(
        [_middle(mark.data_from, mark.data_until) for mark in marks],
        [mark.samples for mark in marks],
        "markers",
        name=grade,
        marker={
            "size": 8,
            "color": theme.grades.get(grade, theme.muted),
            "symbol": GRADE_SYMBOLS.get(grade, "circle-open"),
        },
        hovertemplate="%{x}: %{y} samples",
    )


def _span_trace(spans: Sequence[InForce], grade: str, theme: Theme) -> Trace:
    return {
        "type": "bar",
        "orientation": "h",
        "base": [_text(span.begin) for span in spans],
        "x": [(span.end - span.begin).total_seconds() * 1000.0 for span in spans],
        "y": ["in force"] * len(spans),
        "xaxis": "x2",
        "yaxis": "y2",
        "name": f"in force: {grade}",
        "text": [span.name for span in spans],
        "textposition": "inside",
        "insidetextanchor": "middle",
        "textfont": {"color": theme.surface},
        "hovertemplate": "%{text} from %{base}",
        "marker": {"color": theme.grades[grade], "line": {"color": theme.surface, "width": 2}},
        "showlegend": False,
    }


def _middle(begin: datetime, end: datetime) -> str:
    return _text(begin + (end - begin) / 2)


def _text(time: datetime) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")
