"""Bodies of the calls that the dashboard, and other displays, are drawn from."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.http.schemas import Filter, Identifier, PageQuery, Record, Search, Slug, UtcTime
from app.parameter_sets.schemas import SET_SORTS, SetSort, Status
from app.satellites.schemas import SatelliteQuery

Grade = Literal["accept", "weak", "refuse"]
ThemeName = Literal["light", "dark"]


class SetState(Record):
    """A parameter set at a glance."""

    id: str
    status: Status
    grade: Grade
    method: str
    data_from: UtcTime
    data_until: UtcTime
    created_at: UtcTime
    activated_at: UtcTime | None
    rms_nt: float | None
    cross_validated_rms_nt: float | None


class SessionState(Record):
    """A session at a glance."""

    id: str
    data_from: UtcTime | None
    data_until: UtcTime | None
    samples: int
    created_at: UtcTime


class OverviewShort(Record):
    """One magnetometer, or a satellite that has none yet, in under 500 bytes."""

    satellite: str
    name: str | None
    magnetometer: str | None
    jobs_waiting: int = Field(description="Jobs of the satellite that wait or run.")


class OverviewRow(OverviewShort):
    """One magnetometer, or a satellite that has none yet, with its state at a glance."""

    active: SetState | None
    newest: SetState | None
    last_session: SessionState | None


class OverviewQuery(SatelliteQuery):
    """Which satellites."""

    satellite: Slug | None = None


class HistoryShort(Record):
    """One parameter set of a history in under 500 bytes."""

    id: str
    magnetometer: str
    status: Status
    grade: Grade
    method: str
    data_from: UtcTime
    data_until: UtcTime
    created_at: UtcTime
    rms_nt: float | None


class HistoryRow(HistoryShort):
    """One parameter set in flat numbers, for tables and plots over time; errors are honest standard errors."""

    field_model: str
    orbit_model: str
    activated_at: UtcTime | None
    replaced_id: str | None = Field(description="The set that a rollback of this one would bring back.")
    session_ids: list[str]
    options: str = Field(description="Options of the calibration that are not the defaults, in words, empty for none.")
    samples: int
    rms_before_nt: float | None
    cross_validated_rms_nt: float | None
    orbit_age_days: float | None
    bias_1_nt: float | None
    bias_2_nt: float | None
    bias_3_nt: float | None
    bias_1_error_nt: float | None
    bias_2_error_nt: float | None
    bias_3_error_nt: float | None
    scale_1: float | None
    scale_2: float | None
    scale_3: float | None
    scale_1_error: float | None
    scale_2_error: float | None
    scale_3_error: float | None
    angle_1_deg: float | None
    angle_2_deg: float | None
    angle_3_deg: float | None
    angle_1_error_deg: float | None
    angle_2_error_deg: float | None
    angle_3_error_deg: float | None


class HistoryQuery(PageQuery):
    """Which parameter sets of a satellite."""

    magnetometer: Slug | None = None
    session: Identifier | None = None
    status: Status | None = None
    since: UtcTime | None = Field(None, description="Made from data that reach to this time or beyond.")
    until: UtcTime | None = Field(None, description="Made from data that begin at this time or before.")
    q: Search | None = Field(None, description="Part of an id of the set, its satellite or magnetometer.")
    sort: SetSort = Field("-created", description=SET_SORTS)


class SessionSummary(Record):
    """What a session's readings span, flagged samples left out."""

    b_min_nt: float | None
    b_max_nt: float | None
    b_median_nt: float | None
    sphere_coverage: float | None = Field(description="Share of the body sphere within 15 deg of a raw reading.")
    housekeeping: list[str]


class ResidualSummary(Record):
    """A session's residual under a parameter set that need not come from it."""

    parameter_set_id: str
    samples: int
    mean_nt: float
    std_nt: float
    rms_nt: float
    max_abs_nt: float


class ResidualQuery(Filter):
    """Under which parameter set."""

    parameter_set: Identifier


class ReportQuery(Filter):
    """What a report has beside its sections."""

    pointing: bool = Field(False, description="With how well attitude by magnetometer would point.")


class FigureQuery(Filter):
    """How a figure looks."""

    theme: ThemeName = "light"


class HistoryFigureQuery(FigureQuery):
    """Of which magnetometer."""

    magnetometer: Slug | None = None


class CompareQuery(FigureQuery):
    """Of which two parameter sets."""

    first: Identifier
    second: Identifier


SetFigure = Literal[
    "before-after",
    "residual-time",
    "histogram",
    "autocorrelation",
    "sphere",
    "map",
    "correlation",
    "ablation",
    "bias-path",
]
SessionFigure = Literal["raw", "coverage", "housekeeping"]
HistoryFigure = Literal["history", "residual", "orbit-age", "sessions", "trend"]
