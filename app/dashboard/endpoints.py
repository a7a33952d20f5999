"""HTTP of what displays are drawn from: overview, history, summaries, figures, reports; the same access as the rest."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from app.access.authentication import Reader
from app.access.caller import SYSTEM, Caller
from app.dashboard import figure_routes
from app.dashboard.overview import history_rows, overview_rows, record_of
from app.dashboard.schemas import (
    CompareQuery,
    FigureQuery,
    HistoryFigure,
    HistoryFigureQuery,
    HistoryQuery,
    HistoryRow,
    HistoryShort,
    OverviewQuery,
    OverviewRow,
    OverviewShort,
    ReportQuery,
    ResidualQuery,
    ResidualSummary,
    SessionFigure,
    SessionSummary,
    SetFigure,
)
from app.http.dependencies import Blobs, Db
from app.http.entity_tags import UNCHANGED, revalidated
from app.http.paging import Part, page_of
from app.http.schemas import Page, utc_text
from app.indices.repository import sources_of_record
from app.monitoring.trends import StoredSets, stored_sets, trend_of
from app.orbits.parsing import orbit_of
from app.orbits.repository import OrbitRepository
from app.parameter_sets.bias_paths import path_of_set
from app.parameter_sets.json_listing import listed
from app.parameter_sets.pointing import pointing_impact
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.schemas import ParameterSetQuery
from app.parameter_sets.tables import ParameterSet
from app.records.arrow import from_bytes
from app.records.parameter_set import ParameterSetRecord
from app.records.residual_table import residuals_of
from app.reporting import figures
from app.satellites.repository import SatelliteRepository
from app.sessions.repository import SessionRepository, samples_of
from app.storage.database import Database
from app.storage.store import Store, residuals_key
from magcal_core.calibration.residuals import ResidualTable
from magcal_core.errors import OptionError, TooFewSetsError
from magcal_core.samples import Samples

if TYPE_CHECKING:
    from app.reporting.in_time import SensorInTime

router = APIRouter(tags=["displays"])

MOST_SETS: Final = 1000
"""Parameter sets that a figure of a history has."""
REPORT_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""The report carries its scripts inside and may reach nothing."""
FIGURES: Final[dict[int | str, dict[str, Any]]] = {
    200: {"description": "The figure, as plotly draws it.", "content": {"application/json": {}}}
}
REPORT: Final[dict[int | str, dict[str, Any]]] = {200: {"description": "The report.", "content": {"text/html": {}}}}


@router.get("/overview", response_model=Page[OverviewRow] | Page[OverviewShort], responses=UNCHANGED)
def get_overview(query: Annotated[OverviewQuery, Query()], request: Request, caller: Reader, db: Db) -> Response:
    """Show every magnetometer with its state at a glance; the limit and the total count satellites."""
    return revalidated(request, overview_now(query, caller, db))


def overview_now(query: OverviewQuery, caller: Caller, db: Database) -> Page[OverviewRow] | Page[OverviewShort]:
    """Return every magnetometer with its state."""
    with db.read() as session:
        satellites = SatelliteRepository(session, caller)
        if query.satellite is not None:
            found = Part([satellites.get(query.satellite)], None, 1 if query.total else None)
        else:
            found = satellites.page(query)
        return page_of(overview_rows(session, caller, found.rows), found, query, OverviewShort)


@router.get(
    "/satellites/{satellite_id}/history", response_model=Page[HistoryRow] | Page[HistoryShort], responses=UNCHANGED
)
def get_history(
    satellite_id: str, query: Annotated[HistoryQuery, Query()], request: Request, caller: Reader, db: Db
) -> Response:
    """List the parameter sets of a satellite in flat numbers, for tables and plots over time, the newest first."""
    with db.read() as session:
        SatelliteRepository(session, caller).get(satellite_id)
        found = history_rows(session, caller, satellite_id, query)
    return revalidated(request, found)


@router.get("/sessions/{session_id}/summary")
def get_session_summary(session_id: str, caller: Reader, db: Db, store: Blobs) -> SessionSummary:
    """Show what the readings of a session span."""
    from magcal_core.calibration.observability.information import sphere_coverage

    samples = _samples(session_id, caller, db, store)
    h_nt = samples.h_nt[samples.is_used]
    magnitude = np.linalg.norm(h_nt, axis=1)
    if not magnitude.any():
        names = list(samples.housekeeping)
        return SessionSummary(b_min_nt=None, b_max_nt=None, b_median_nt=None, sphere_coverage=None, housekeeping=names)
    return SessionSummary(
        b_min_nt=float(magnitude.min()),
        b_max_nt=float(magnitude.max()),
        b_median_nt=float(np.median(magnitude)),
        sphere_coverage=sphere_coverage(h_nt[magnitude > 0] / magnitude[magnitude > 0][:, None]),
        housekeeping=list(samples.housekeeping),
    )


@router.get("/sessions/{session_id}/residual")
def get_session_residual(
    session_id: str, query: Annotated[ResidualQuery, Query()], caller: Reader, db: Db, store: Blobs
) -> ResidualSummary:
    """Show the residual of |B| that a session has under a parameter set, which need not come from it."""
    from app.monitoring.residual_check import residual_under

    with db.read() as session:
        row = ParameterSetRepository(session, caller).get(query.parameter_set)
        telemetry = SessionRepository(session, caller).get(session_id)
        near = []
        if telemetry.data_from is not None and telemetry.data_until is not None:
            orbits = OrbitRepository(session, SYSTEM, telemetry.satellite_id)
            near = orbits.around(telemetry.data_from, telemetry.data_until, 14.0)
    samples = _samples(session_id, caller, db, store)
    with db.read() as session:
        sources = sources_of_record(session, row.record, samples.t_utc)
    residual = residual_under(samples, [orbit_of(one.content) for one in near], record_of(row), sources)
    return ResidualSummary(
        parameter_set_id=row.id,
        samples=residual.size,
        mean_nt=float(residual.mean()),
        std_nt=float(residual.std()),
        rms_nt=float(np.sqrt(np.mean(residual**2))),
        max_abs_nt=float(np.abs(residual).max()),
    )


@router.get("/parameter-sets/{parameter_set_id}/figures/{figure}", response_class=Response, responses=FIGURES)
def get_parameter_set_figure(
    *,
    parameter_set_id: str,
    figure: SetFigure,
    query: Annotated[FigureQuery, Query()],
    request: Request,
    caller: Reader,
    db: Db,
    store: Blobs,
) -> Response:
    """Draw a figure of a parameter set."""
    row = _parameter_set(parameter_set_id, caller, db)
    etag = figure_routes.etag("set", row.id, figure, query.theme)
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers={"ETag": etag})
    if figure == "bias-path":
        errors_nt = record_of(row)["standard_errors"]["bias_nt"]
        path = path_of_set(row.id, caller, db, store)
        return figure_routes.answer(figures.bias_path_figure(path, figures.THEMES[query.theme], errors_nt), etag)
    residuals = None if figure in figure_routes.OF_RECORD else _residuals(row, db, store)
    made = figure_routes.parameter_set_figure(figure, record_of(row), residuals, query.theme)
    return figure_routes.answer(made, etag)


@router.get("/sessions/{session_id}/figures/{figure}", response_class=Response, responses=FIGURES)
def get_session_figure(
    *,
    session_id: str,
    figure: SessionFigure,
    query: Annotated[FigureQuery, Query()],
    caller: Reader,
    db: Db,
    store: Blobs,
) -> Response:
    """Draw a figure of a session."""
    return figure_routes.answer(
        figure_routes.session_figure(figure, _samples(session_id, caller, db, store), query.theme)
    )


@router.get("/satellites/{satellite_id}/figures/{figure}", response_class=Response, responses=FIGURES)
def get_history_figure(
    *,
    satellite_id: str,
    figure: HistoryFigure,
    query: Annotated[HistoryFigureQuery, Query()],
    request: Request,
    caller: Reader,
    db: Db,
) -> Response:
    """Draw a figure of a satellite's history: its last 1,000 parameter sets."""
    with db.read() as session:
        SatelliteRepository(session, caller).get(satellite_id)
        if figure == "trend":
            return figure_routes.answer(figure_routes.trend_figure(session, caller, satellite_id, query))
        if figure == "sessions":
            return figure_routes.answer(figure_routes.timeline_figure(session, caller, satellite_id, query))
        wanted = ParameterSetQuery(satellite=satellite_id, magnetometer=query.magnetometer, limit=MOST_SETS)
        sets = listed(session.connection(), caller, wanted)
        etag = figure_routes.etag("history", sets.tag, figure, query.theme)
        if request.headers.get("if-none-match") == etag:
            return Response(status_code=304, headers={"ETag": etag})
        made = figure_routes.history_figure(session, sets, figure, query.theme)
    return figure_routes.answer(made, etag)


@router.get("/figures/compare", response_class=Response, responses=FIGURES)
def get_comparison_figure(query: Annotated[CompareQuery, Query()], caller: Reader, db: Db) -> Response:
    """Draw the differences between two parameter sets."""
    first, second = (record_of(_parameter_set(one, caller, db)) for one in (query.first, query.second))
    return figure_routes.answer(figure_routes.comparison(first, second, query.theme))


@router.get(
    "/parameter-sets/{parameter_set_id}/report",
    response_class=Response,
    responses={200: {"content": {"text/html": {}}}},
)
def get_report(
    parameter_set_id: str,
    caller: Reader,
    db: Db,
    store: Blobs,
    query: Annotated[ReportQuery, Query()],
) -> Response:
    """Give the report of a parameter set as one page that needs nothing else and prints as it stands."""
    from app.reporting.report import render_report

    row = _parameter_set(parameter_set_id, caller, db)
    record: ParameterSetRecord = record_of(row)
    with db.read() as session:
        record["session_ids"] = ParameterSetRepository(session, caller).session_ids([row])[row.id]
        sets = stored_sets(session, row.satellite_id, row.magnetometer_id)
    impact = pointing_impact(parameter_set_id, caller, db) if query.pointing else None
    table, in_time = _residuals(row, db, store), _in_time(sets)
    page = render_report(record, table, made_at=_now(), pointing=impact, in_time=in_time)
    name = f"magcal-{row.satellite_id}-{row.magnetometer_id}-{row.id}.html"
    headers = {"Content-Security-Policy": REPORT_POLICY, "Content-Disposition": f'inline; filename="{name}"'}
    return Response(page, media_type="text/html; charset=utf-8", headers=headers)


def _in_time(sets: StoredSets) -> SensorInTime:
    from app.reporting.in_time import SensorInTime

    try:
        return SensorInTime.of_trend(trend_of(sets))
    except (TooFewSetsError, OptionError) as error:
        return SensorInTime.untold(error.message)


def _now() -> str:
    from app.storage.database import utc_now

    return utc_text(utc_now())[:19].replace("T", " ") + " UTC"


def _parameter_set(parameter_set_id: str, caller: Caller, db: Db) -> ParameterSet:
    with db.read() as session:
        return ParameterSetRepository(session, caller).get(parameter_set_id)


def _residuals(row: ParameterSet, db: Db, store: Store) -> ResidualTable:
    with db.read() as session:
        content = store.get(session, residuals_key(row.id), row.residuals_sha256)
    return _decoded(row.residuals_sha256, content)


@lru_cache(maxsize=8)
def _decoded(_sha256: str, content: bytes) -> ResidualTable:
    """A page asks for six figures of one table; it is decoded once."""
    return residuals_of(from_bytes(content))


def _samples(session_id: str, caller: Caller, db: Db, store: Store) -> Samples:
    with db.read() as session:
        sessions = SessionRepository(session, caller)
        sessions.get(session_id)
        return samples_of(sessions.columns(session_id, store))
