"""Which figure belongs to which name in an address."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

import numpy as np
from fastapi import Response
from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.dashboard.overview import timeline
from app.dashboard.schemas import HistoryFigureQuery
from app.dashboard.set_summaries import summaries
from app.errors import NotFoundError
from app.parameter_sets.json_listing import Listed
from app.records.parameter_set import ParameterSetRecord
from app.reporting import figures
from app.reporting.figures.extras import ablation_rows
from app.reporting.figures.style import Theme
from magcal_core.arrays import Floats
from magcal_core.calibration.residuals import ResidualTable
from magcal_core.samples import Samples

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

OF_RECORD: Final = frozenset({"correlation", "ablation"})
"""Figures of a parameter set that need no residual table."""


def _along_field(residuals: ResidualTable) -> Floats:
    """Return |corrected| - |model|, which scalar and vector residuals both have, shape (n,), nT."""
    return residuals.corrected_nt - residuals.model_nt


def _sphere(residuals: ResidualTable, theme: Theme) -> Figure:
    if residuals.corrected_base_nt is None:
        raise NotFoundError("this parameter set was kept without the directions of its samples")
    return figures.residual_sphere(residuals.corrected_base_nt, _along_field(residuals), theme)


def _map(residuals: ResidualTable, theme: Theme) -> Figure:
    if residuals.r_itrf_km is None:
        raise NotFoundError("the positions of these samples are not known: the telemetry brought its own reference")
    return figures.residual_map(residuals.t_utc, residuals.r_itrf_km, _along_field(residuals), theme)


OF_RESIDUALS: Final[Mapping[str, Callable[[ResidualTable, Theme], Figure]]] = {
    "before-after": figures.before_after,
    "residual-time": figures.residual_time,
    "histogram": figures.residual_histogram,
    "autocorrelation": figures.residual_autocorrelation,
    "sphere": _sphere,
    "map": _map,
}


def parameter_set_figure(name: str, record: ParameterSetRecord, residuals: ResidualTable | None, theme: str) -> Figure:
    """Return the figure ``name`` of a parameter set."""
    look = figures.THEMES[theme]
    if name == "correlation":
        return figures.correlation_matrix(record, look)
    if name == "ablation":
        return figures.ablation_bar(ablation_rows(record), look)
    if residuals is None:
        raise NotFoundError("this parameter set has no residual table")
    return OF_RESIDUALS[name](residuals, look)


def session_figure(name: str, samples: Samples, theme: str) -> Figure:
    """Return the figure ``name`` of a session."""
    look = figures.THEMES[theme]
    if name == "raw":
        return figures.raw_field(samples, look)
    if name == "coverage":
        return figures.sphere_coverage(samples.h_nt[samples.is_used], look)
    return figures.housekeeping(samples, look)


def history_figure(session: Session, sets: Listed, name: str, theme: str) -> Figure:
    """Return the figure ``name`` of the history that ``sets`` make."""
    look = figures.THEMES[theme]
    history = summaries(session, [set_id for set_id, _ in sets.sets])
    if name == "history":
        return figures.parameter_history(history, look)
    if name == "residual":
        return figures.rms_history(history, look)
    return figures.tle_age_history(history, look)


def timeline_figure(session: Session, caller: Caller, satellite_id: str, query: HistoryFigureQuery) -> Figure:
    """Return the figure of a satellite's sessions and of what was in force."""
    return figures.session_timeline(
        *timeline(session, caller, satellite_id, query.magnetometer), figures.THEMES[query.theme]
    )


def comparison(first: ParameterSetRecord, second: ParameterSetRecord, theme: str) -> Figure:
    """Return the figure of the differences between two parameter sets."""
    return figures.compare_sets(first, second, figures.THEMES[theme])


def etag(*parts: str) -> str:
    """Return the entity tag of a figure of something that never changes, as this version draws it."""
    text = "\n".join((*parts, version("magcal-service"), version("plotly"), np.__version__))
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


def answer(figure: Figure, tag: str | None = None) -> Response:
    """Return the answer that carries ``figure``; one with a tag may be kept by the browser that asked."""
    headers = {} if tag is None else {"ETag": tag, "Cache-Control": "private, no-cache"}
    return Response(str(figure.to_json()), media_type="application/json", headers=headers)
