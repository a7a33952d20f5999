"""Every plot, once, in Python: dashboard, report and notebook draw the same; data in, plotly figures out."""

from app.reporting.figures.parameters import (
    AblationRow,
    ablation_bar,
    compare_sets,
    correlation_matrix,
    parameter_history,
    rms_history,
    short_name,
    tle_age_history,
)
from app.reporting.figures.residuals import (
    before_after,
    residual_autocorrelation,
    residual_histogram,
    residual_map,
    residual_sphere,
    residual_time,
)
from app.reporting.figures.sessions import housekeeping, raw_field, sphere_coverage
from app.reporting.figures.studies import coefficient_errors, energy_terms, error_against_angle, settling
from app.reporting.figures.style import DARK, LIGHT, MAX_POINTS, THEMES, Theme
from app.reporting.figures.timeline import InForce, SessionMark, session_timeline

__all__ = [
    "DARK",
    "LIGHT",
    "MAX_POINTS",
    "THEMES",
    "AblationRow",
    "InForce",
    "SessionMark",
    "Theme",
    "ablation_bar",
    "before_after",
    "coefficient_errors",
    "compare_sets",
    "correlation_matrix",
    "energy_terms",
    "error_against_angle",
    "housekeeping",
    "parameter_history",
    "raw_field",
    "residual_autocorrelation",
    "residual_histogram",
    "residual_map",
    "residual_sphere",
    "residual_time",
    "rms_history",
    "session_timeline",
    "settling",
    "short_name",
    "sphere_coverage",
    "tle_age_history",
]
