"""Figures: what is drawn is what was given, thin enough for a browser, readable by everyone, free of the network."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from plotly.graph_objects import Figure

from app.records.parameter_set import ParameterSetRecord
from app.reporting import figures
from app.reporting.figures.style import time_line
from magcal_core.calibration.residuals import ResidualTable, StoredReadings
from magcal_core.calibration.sessions.trend import trend
from magcal_core.calibration.terms.bias_path import BiasPath
from magcal_core.samples import SampleFlag, Samples
from tests.magcal_core.calibration.sessions.histories import history as history_of_sets

START = np.datetime64("2022-02-19T22:37:44.130", "ns")


def residuals(n: int = 575, components: int = 1, gap_days: float = 0.0) -> ResidualTable:
    rng = np.random.default_rng(5)
    seconds = np.arange(n) * 10.0
    seconds[n // 2 :] += gap_days * 86400
    model = 34000 + 11000 * np.sin(np.arange(n) / 90.0)
    residual = rng.normal(0, 100, (n, components)) if components > 1 else rng.normal(0, 100, n)
    along = residual if residual.ndim == 1 else residual[:, 0]
    weight = np.ones(n)
    weight[10:20] = 0.0
    t_utc = START + (seconds * 1e9).astype("timedelta64[ns]")
    readings = StoredReadings(raw_nt=model * 1.05, corrected_nt=model + along)
    return ResidualTable(t_utc, model, residual, weight, np.zeros(n, np.uint16), readings)


def parameter_set(day: int, grade: str = "accept") -> ParameterSetRecord:
    def values(b: float, k: float, e: float) -> dict[str, object]:
        groups = {"bias_nt": [b, -b, 2 * b], "scale": [k] * 3, "nonorthogonality_deg": [e, -e, e]}
        return groups | {"time_offset_s": None, "regressors": {}}

    statistics = {"mean_nt": 0.0, "std_nt": 100.0, "rms_nt": 100.0, "max_abs_nt": 400.0, "max_percent": 2.0}
    start = np.datetime64("2022-02-19T00:00:00") + np.timedelta64(day, "D")
    names = [f"{group}[{i}]" for group in ("bias_nt", "scale", "nonorthogonality_deg") for i in range(3)]
    spread = np.diag([60.0] * 3 + [1e-3] * 3 + [0.1] * 3)
    mixed = np.eye(9) + 0.5 * np.eye(9, k=1) + 0.5 * np.eye(9, k=-1)
    record = {
        "status": "candidate",
        "verdict": {"grade": grade, "reasons": []},
        "data_from": f"{start}Z",
        "data_until": f"{start + np.timedelta64(2, 'h')}Z",
        "method": "scalar",
        "field_model": "igrf-14",
        "orbit_model": "sgp4",
        "parameters": values(1000.0 + 50 * day, 1.03, 4.5),
        "standard_errors": values(60.0, 1e-3, 0.1),
        "formal_standard_errors": values(6.0, 1e-4, 0.01),
        "parameter_names": names,
        "covariance": (spread @ mixed @ spread).tolist(),
        "matrix": np.eye(3).tolist(),
        "correction_matrix": np.eye(3).tolist(),
        "candidates": [],
        "statistics": {"samples": 575, "rejected": 10, "cross_validated_rms_nt": 110.0}
        | {"before": statistics, "after": statistics},
        "observability": {"index": 30.0, "condition_number": 9.0, "sphere_coverage": 0.8, "weak_directions": []},
        "warnings": [],
        "provenance": {"orbits": [{"id": "tle", "age_days": 0.5 + day}], "options": {}},
    }
    return cast(ParameterSetRecord, record)


def session() -> Samples:
    n = 400
    rng = np.random.default_rng(8)
    t_utc = START + np.arange(n) * np.timedelta64(10, "s")
    flags = np.zeros(n, np.uint16)
    flags[7] = SampleFlag.SATURATED
    return Samples(
        t_utc, rng.normal(0, 30000, (n, 3)), housekeeping={"temperature": np.linspace(0, 40, n)}, flags=flags
    )


def positions() -> np.ndarray:
    angle = np.linspace(0, 9, 575)
    return 6938 * np.stack([np.cos(angle), 0.1 * np.sin(angle), np.sin(angle)], axis=1)


def history() -> tuple[list[figures.SessionMark], list[figures.InForce]]:
    day = [datetime(2022, 2, 19 + i, tzinfo=UTC) for i in range(4)]
    marks = [figures.SessionMark(day[i], day[i + 1], 700, grade) for i, grade in enumerate(["accept", "weak", None])]
    spans = [figures.InForce(day[0], day[1], "a1", "weak"), figures.InForce(day[1], day[3], "b2", "accept")]
    return marks, spans


def bias_path() -> BiasPath:
    blocks = T_UTC[::10]
    wave = np.sin(np.arange(len(blocks)) / 9.0)[:, None] * [40.0, -20.0, 10.0]
    return BiasPath(blocks, wave, np.full(wave.shape, 5.0), np.zeros(3), np.full(3, 2.0), ())


ROWS = [figures.AblationRow("plain", 181.5, 247.0, False), figures.AblationRow("+ temperature", 168.3, None, True)]
T_UTC = residuals().t_utc
SCALAR_NT = residuals().residual_nt
DRAWINGS: dict[str, Callable[[figures.Theme], Figure]] = {
    "before_after": lambda theme: figures.before_after(residuals(gap_days=47), theme),
    "residual_time": lambda theme: figures.residual_time(residuals(components=3), theme),
    "residual_histogram": lambda theme: figures.residual_histogram(residuals(), theme),
    "residual_autocorrelation": lambda theme: figures.residual_autocorrelation(residuals(), theme),
    "residual_map": lambda theme: figures.residual_map(T_UTC, positions(), SCALAR_NT, theme),
    "residual_sphere": lambda theme: figures.residual_sphere(positions(), SCALAR_NT, theme),
    "parameter_history": lambda theme: figures.parameter_history([parameter_set(9), parameter_set(0)], theme),
    "tle_age_history": lambda theme: figures.tle_age_history([parameter_set(0), parameter_set(9)], theme),
    "rms_history": lambda theme: figures.rms_history([parameter_set(0), parameter_set(9, "refuse")], theme),
    "correlation_matrix": lambda theme: figures.correlation_matrix(parameter_set(0), theme),
    "ablation_bar": lambda theme: figures.ablation_bar(ROWS, theme),
    "compare_sets": lambda theme: figures.compare_sets(parameter_set(0), parameter_set(9), theme),
    "raw_field": lambda theme: figures.raw_field(session(), theme),
    "sphere_coverage": lambda theme: figures.sphere_coverage(session().h_nt, theme),
    "housekeeping": lambda theme: figures.housekeeping(session(), theme),
    "session_timeline": lambda theme: figures.session_timeline(*history(), theme),
    "settling": lambda theme: figures.settling(np.arange(9000.0), {"raw": np.full(9000, 24.0)}, theme),
    "error_against_angle": lambda theme: figures.error_against_angle(np.arange(3.0), {"+++": np.arange(3.0)}, theme),
    "energy_terms": lambda theme: figures.energy_terms(T_UTC, {"kinetic": SCALAR_NT, "tide": SCALAR_NT}, theme),
    "coefficient_errors": lambda theme: figures.coefficient_errors(
        np.arange(2.0, 13), np.full(11, 1e-7), {"1 cm": np.full(11, 1e-10)}, theme
    ),
    "trend_figure": lambda theme: figures.trend_figure(trend(history_of_sets(21, 9).sets), theme),
    "bias_path_figure": lambda theme: figures.bias_path_figure(bias_path(), theme),
}


def points(trace: object) -> int:
    return max(len(np.atleast_1d(axis)) for axis in (trace.x, trace.y) if axis is not None)  # type: ignore[attr-defined]


@pytest.mark.parametrize("theme", figures.THEMES.values(), ids=figures.THEMES)
@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_every_figure_is_svg_bounded_and_names_no_address(
    draw: Callable[[figures.Theme], Figure], theme: figures.Theme
) -> None:
    figure = draw(theme)
    text = figure.to_json()
    assert json.loads(text)["data"]
    assert {trace.type for trace in figure.data} <= {"scatter", "bar", "heatmap", "contour"}
    assert all(points(trace) <= figures.MAX_POINTS for trace in figure.data)
    assert "http" not in text


def test_every_figure_of_the_package_is_in_this_test() -> None:
    functions = {name for name in figures.__all__ if name.islower() and name != "short_name"}
    assert functions == set(DRAWINGS)


def test_a_long_session_is_thinned_with_its_extremes_kept() -> None:
    table = residuals(100_000)
    table.raw_nt[54_321], table.raw_nt[12_345] = 90_000.0, 1_000.0
    raw = figures.before_after(table).data[0]
    assert len(raw.x) <= figures.MAX_POINTS
    assert (np.nanmax(raw.y), np.nanmin(raw.y)) == (90_000.0, 1_000.0)


def test_a_line_breaks_at_a_gap_and_is_not_thinned_where_it_need_not_be() -> None:
    table = residuals(100, gap_days=3)
    x, y = time_line(table.t_utc, table.model_nt)
    assert len(x) == 101
    assert np.flatnonzero(np.isnan(y)).tolist() == [50]
    assert np.all(np.diff(x) > 0)


def test_sessions_weeks_apart_share_a_time_axis_without_the_weeks_between() -> None:
    axis = figures.before_after(residuals(gap_days=47)).layout.xaxis
    assert len(axis.rangebreaks) == 1
    assert axis.ticktext[1].startswith("2022-04-07")


def test_left_out_samples_are_crosses_and_not_part_of_the_line() -> None:
    figure = figures.residual_time(residuals())
    line, crosses = figure.data
    assert (crosses.name, len(crosses.x)) == ("left out", 10)
    assert int(np.isnan(line.y).sum()) == 10


def test_the_histogram_counts_every_residual_of_the_fit_within_its_reach() -> None:
    table = residuals()
    bars = figures.residual_histogram(table).data[0]
    used = table.residual_nt[table.weight > 0]
    reach = 1.05 * np.abs(np.quantile(used, [0.001, 0.999])).max()
    assert bars.y.sum() == np.count_nonzero(np.abs(used) <= reach)


def test_history_is_in_time_order_with_honest_bars() -> None:
    first = figures.parameter_history([parameter_set(9), parameter_set(0, "weak")]).data[0]
    assert list(first.y) == [1000.0, 1450.0]
    assert list(first.error_y.array) == [60.0, 60.0]
    assert list(first.marker.symbol) == ["diamond", "circle"]


def test_a_long_history_is_a_band_of_one_error_and_marks_only_what_is_doubtful() -> None:
    sets = [parameter_set(day, "weak" if day == 7 else "accept") for day in range(300)]
    low, high, line, marks = figures.parameter_history(sets).data[:4]
    np.testing.assert_allclose(high.y - low.y, 120.0)
    np.testing.assert_allclose(line.y, 0.5 * (low.y + high.y))
    assert np.flatnonzero(np.isfinite(marks.y)).tolist() == [7]


def test_the_lines_of_the_map_find_the_south_atlantic_anomaly() -> None:
    """The weakest field of the Earth lies off the coast of Brazil: about 26 S, 60 W in 2022, at any low height."""
    lines = figures.residual_map(T_UTC, positions(), SCALAR_NT).data[0]
    row, column = np.unravel_index(np.argmin(lines.z), lines.z.shape)
    assert abs(lines.y[row] + 26) <= 10
    assert abs(lines.x[column] + 60) <= 10
    assert 15_000 < np.min(lines.z) < 23_000


CAPES = {  # published positions, deg east and north, of points that no map of the world leaves out
    "Cape Horn": (-67.3, -56.0),
    "Cape Agulhas": (20.0, -34.8),
    "Cabo da Roca": (-9.5, 38.8),
    "Cape Comorin": (77.5, 8.1),
    "North Cape": (25.8, 71.2),
}


@pytest.mark.parametrize("cape", CAPES.values(), ids=CAPES)
def test_the_coastlines_pass_the_capes(cape: tuple[float, float]) -> None:
    """Within a degree: at this scale an island or a bay of that size is no longer drawn."""
    line = figures.residual_map(T_UTC, positions(), SCALAR_NT).data[1]
    longitude, latitude = (np.array(axis, dtype=float) for axis in (line.x, line.y))
    share = np.linspace(0.0, 1.0, 50)
    x, y = (np.outer(axis[:-1], 1 - share) + np.outer(axis[1:], share) for axis in (longitude, latitude))
    assert np.nanmin(np.hypot(x - cape[0], y - cape[1])) < 1.0


def test_correlations_come_from_the_covariance() -> None:
    """Planted: neighbours correlate with 0.5 whatever their units."""
    z = np.asarray(figures.correlation_matrix(parameter_set(0)).data[0].z)
    np.testing.assert_allclose(z, np.eye(9) + 0.5 * np.eye(9, k=1) + 0.5 * np.eye(9, k=-1), atol=1e-9)


def test_a_difference_is_in_combined_standard_errors() -> None:
    """450 nT between sets with 60 nT each: 450 / (60 sqrt 2) = 5.30."""
    bar = figures.compare_sets(parameter_set(0), parameter_set(9)).data[0]
    assert bar.y[0] == pytest.approx(5.303, abs=1e-3)


def contrast(first: str, second: str) -> float:
    def luminance(colour: str) -> float:
        channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    high, low = sorted((luminance(first), luminance(second)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("theme", figures.THEMES.values(), ids=figures.THEMES)
def test_text_is_readable_on_every_surface(theme: figures.Theme) -> None:
    """WCAG 2.2 AA: text 4.5:1; lines of the figure 3:1 (the six series carry names beside their colours)."""
    for colour in (theme.ink, theme.muted, *theme.grades.values()):
        assert contrast(colour, theme.surface) >= 4.5
    for colour in (theme.before, theme.after, theme.model):
        assert contrast(colour, theme.surface) >= 3.0
    for _, colour in figures.correlation_matrix(parameter_set(0), theme).data[0].colorscale:
        assert contrast(colour, theme.ink) >= 4.5


@pytest.mark.parametrize("theme", figures.THEMES.values(), ids=figures.THEMES)
def test_an_outlier_does_not_flatten_the_colours_and_zero_can_be_seen(theme: figures.Theme) -> None:
    """The scale ends where 99 of 100 residuals do and is symmetric about zero, whose points stand out by 2:1."""
    table = residuals()
    residual_nt = table.residual_nt.copy()
    residual_nt[7] = 1e6
    directions = np.random.default_rng(3).normal(size=(residual_nt.size, 3))
    for trace in figures.residual_sphere(directions, residual_nt, theme).data:
        assert trace.marker.cmax == -trace.marker.cmin < 400.0
        ((_, zero),) = (stop for stop in trace.marker.colorscale if stop[0] == 0.5)
        assert contrast(zero, theme.surface) >= 2.0


@pytest.mark.parametrize("theme", figures.THEMES.values(), ids=figures.THEMES)
def test_before_after_and_the_verdicts_differ_for_people_without_red_or_green_cones(theme: figures.Theme) -> None:
    """Vienot 1999 simulation of protanopia and deuteranopia in linear RGB; sRGB distance of at least 60 of 441."""
    protan = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
    deutan = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])

    def seen(colour: str, matrix: np.ndarray) -> np.ndarray:
        linear = (np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255) ** 2.2
        return np.clip(matrix @ linear, 0, 1) ** (1 / 2.2) * 255

    for matrix in (protan, deutan):
        assert np.linalg.norm(seen(theme.before, matrix) - seen(theme.after, matrix)) > 60


def test_plotly_is_imported_only_when_something_is_drawn() -> None:
    code = "import sys, app.reporting.figures; sys.exit('plotly' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_one_place_imports_plotly() -> None:
    folder = Path(figures.__file__).parent
    users = [path.name for path in folder.glob("*.py") if re.search(r"^    import plotly", path.read_text(), re.M)]
    assert sorted(set(users) - {"style.py"}) == []
