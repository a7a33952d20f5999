"""The report of one parameter set: a self-contained page, fit for a review, that prints as it stands."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from app.records.parameter_set import ParameterSetRecord, ParametersRecord, parameter_values
from app.reporting import figures
from app.reporting.figures.extras import ablation_rows
from app.reporting.figures.page import POLICY, plotly_source, script_json
from magcal_core.calibration.residuals import ResidualTable
from magcal_core.errors import MagcalError
from magcal_core.sensor.regressors import is_of_scale, source_of

if TYPE_CHECKING:
    from jinja2 import Environment
    from plotly.graph_objects import Figure

    from app.reporting.in_time import SensorInTime
    from app.reporting.pointing import ImpactRecord

FIGURE_WIDTH: Final = 700
"""Width of a figure, px: what an A4 page at 96 dpi has between margins of 12 mm."""
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PDF_TIMEOUT_S: Final = 120
UNITS: Final = {"bias_nt": "nT", "scale": "", "nonorthogonality_deg": "deg", "time_offset_s": "s", "regressors": "nT"}
DIGITS: Final = {"bias_nt": 2, "scale": 6, "nonorthogonality_deg": 4, "time_offset_s": 3, "regressors": 4}


class NoBrowserError(MagcalError):
    """There is no browser engine on this machine to print a PDF with."""

    code = "no_browser"


class PrintError(MagcalError):
    """The browser engine did not print the PDF."""

    code = "print"


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One parameter as tables show it: its value with the honest and the formal standard error."""

    symbol: str
    name: str
    unit: str
    value: str
    honest: str
    formal: str
    ratio: str


@dataclass(frozen=True, slots=True)
class Plate:
    """One figure of the report with its title, what it shows, and the figure in JSON."""

    key: str
    title: str
    caption: str
    json: str


def render_report(
    record: ParameterSetRecord,
    residuals: ResidualTable | None = None,
    *,
    made_at: str | None = None,
    pointing: ImpactRecord | None = None,
    in_time: SensorInTime | None = None,
) -> str:
    """Return the report of ``record`` as one HTML document that needs nothing else.

    Parameters
    ----------
    residuals : ResidualTable, optional
        Without it the report has no figure of residuals, and says so.
    made_at : str, optional
        When the report was made, as text; the caller reads the clock.
    pointing : ImpactRecord, optional
        What the parameter set buys, as `app.reporting.pointing.pointing_of` finds it; None leaves that section out.
    in_time : SensorInTime, optional
        The trend of the magnetometer's parameter sets; None leaves that section out.
    """
    plates = _plates(record, residuals) + _trend_plates(in_time)
    return (
        _environment()
        .get_template("report.html")
        .render(
            record=record,
            rows=parameter_rows(record),
            plates=plates,
            has_residuals=residuals is not None,
            ablation=ablation_rows(record),
            command=command_line(record),
            options=sorted(item for item in record["provenance"].get("options", {}).items() if item[0] != "method"),
            document_json=script_json(json.dumps(record, indent=1)),
            made_at=made_at,
            pointing=pointing,
            in_time=in_time,
            plotly_js=plotly_source() if plates else "",
            title=_title(record),
            policy=POLICY,
        )
    )


def parameter_rows(record: ParameterSetRecord) -> list[ParameterRow]:
    """Return every parameter of ``record`` in the order of its covariance."""
    values = parameter_values(record["parameters"])
    return [_row(record, name, values[name]) for name in record["parameter_names"]]


def command_line(record: ParameterSetRecord) -> str:
    """Return the command that repeats the calibration of ``record`` from its files."""
    options = record["provenance"].get("options", {})
    flags = {
        "method": record["method"],
        "orbit": options.get("orbit"),
        "field": options.get("field"),
        "field-max-degree": options.get("field_max_degree"),
        "field-file": "FILE" if record["provenance"].get("field_file") else None,
        "index-gap": options.get("index_gap") if options.get("index_gap") != "refuse" else None,
        "time-offset": options.get("time_offset"),
        "robust": options.get("robust"),
        "noise-model": options.get("noise_model"),
        "noise": options.get("noise_nt"),
        "integration": options.get("integration_s") or None,
        "bias-steps": options.get("bias_steps"),
        "windows": options.get("windows"),
        "locked-terms": options.get("locked_terms"),
        "bootstrap": options.get("bootstrap") or None,
        "seed": options.get("seed") or None,
        "max-orbit-age-days": options.get("max_orbit_age_days"),
    }
    regressors = options.get("regressors")
    if isinstance(regressors, Sequence) and regressors:
        flags["regressors"] = regressors if isinstance(regressors, str) else ",".join(str(name) for name in regressors)
    needs_orbit = record["orbit_model"] in {"sgp4", "numerical"}
    given = [f"--{name} {value}" for name, value in flags.items() if value not in (None, "")]
    given += ["--index INDEX"] if record["provenance"].get("indices") else []
    given += [f"--{name}" for name in ("time-drift", "quiet-only") if options.get(name.replace("-", "_")) is True]
    return " ".join(["magcal calibrate TELEMETRY", *(["--tle TLE"] if needs_orbit else []), *given, "--json"])


def print_pdf(html: str, target: Path) -> None:
    """Write ``html`` to ``target`` as PDF through a browser engine.

    Raises
    ------
    NoBrowserError
        None of `BROWSERS` is installed.
    PrintError
        The engine failed or took longer than `PDF_TIMEOUT_S`.
    """
    engine = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if engine is None:
        raise NoBrowserError(f"no browser engine to print with; install one of {', '.join(BROWSERS)}")
    with tempfile.TemporaryDirectory(prefix="magcal-report-") as folder:
        page, printed = Path(folder, "report.html"), Path(folder, "report.pdf")
        page.write_text(html, encoding="utf-8")
        command = [
            engine,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--no-first-run",
            f"--user-data-dir={folder}/profile",
            "--no-pdf-header-footer",
            "--virtual-time-budget=20000",
            f"--print-to-pdf={printed}",
            page.as_uri(),
        ]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=PDF_TIMEOUT_S)  # noqa: S603
        except subprocess.SubprocessError as error:
            raise PrintError(f"{engine} did not print the report: {error}") from error
        if not printed.exists():
            raise PrintError(f"{engine} wrote no PDF")
        shutil.move(printed, target)


def _title(record: ParameterSetRecord) -> str:
    of = " ".join(name for name in (record.get("satellite"), record.get("magnetometer")) if name)
    return f"Magnetometer calibration {of}".strip()


def _per(regressor: str) -> str:
    return f"per {source_of(regressor)}" if is_of_scale(regressor) else f"nT per {regressor}"


def _row(record: ParameterSetRecord, name: str, value: float) -> ParameterRow:
    group = name.partition("[")[0]
    kind = group.partition(".")[0]
    digits = 7 if is_of_scale(group) else DIGITS.get(kind, 4)
    honest = _error(record["standard_errors"], name)
    formal = _error(record["formal_standard_errors"], name)
    unit = UNITS.get(kind, "")
    return ParameterRow(
        symbol=figures.short_name(name),
        name=name,
        unit=_per(group.removeprefix("regressors.")) if kind == "regressors" else unit,
        value=f"{value:.{digits}f}",
        honest="" if honest is None else f"{honest:.{digits}f}",
        formal="" if formal is None else f"{formal:.{digits}f}",
        ratio=f"{honest / formal:.1f}" if honest and formal else "",
    )


def _error(errors: ParametersRecord, name: str) -> float | None:
    return parameter_values(errors).get(name)


def _plates(record: ParameterSetRecord, residuals: ResidualTable | None) -> list[Plate]:
    made: list[tuple[str, str, str, Figure]] = []
    if residuals is not None:
        made += _residual_plates(residuals, figures.IndexSeries.of_record(dict(record)))
    made.append(
        (
            "correlation",
            "Correlation of the parameters",
            "From the honest covariance. Pairs near ±1 cannot be told apart by these data.",
            figures.correlation_matrix(record),
        )
    )
    rows = ablation_rows(record)
    if rows:
        caption = "A model is taken for its cross-validated residual, never for its residual in the fit."
        made.append(("ablation", "Models that were tried", caption, figures.ablation_bar(rows)))
    return [Plate(key, title, caption, _sized_json(figure)) for key, title, caption, figure in made]


def _trend_plates(in_time: SensorInTime | None) -> list[Plate]:
    from plotly.graph_objects import Figure

    if in_time is None or in_time.figure is None:
        return []
    caption = (
        "All parameter sets of the magnetometer with 95 % bars, hollow where they do not count; the band holds the "
        "parameters in 95 of 100 cases. Below: what the set in force is off by at most, and when it passes the limit."
    )
    figure = _sized_json(Figure(in_time.figure))
    return [Plate("trend", "The parameters in time", caption, figure)]


def _residual_plates(residuals: ResidualTable, index: figures.IndexSeries | None) -> list[tuple[str, str, str, Figure]]:
    along = residuals.residual_nt
    scalar = along if along.ndim == 1 else residuals.corrected_nt - residuals.model_nt
    plates = [
        (
            "before-after",
            "|B| before and after, against the model",
            "Above the reading as it came, below after the correction; the dots are the reference field.",
            figures.before_after(residuals),
        ),
        (
            "residual-time",
            "Residual against time",
            "A pattern that repeats with the orbit or the spin is an error that the model does not have."
            + ("" if index is None else f" Below: the index {index.name} of the external field."),
            figures.residual_time(residuals, index=index),
        ),
        (
            "histogram",
            "Distribution of the residuals",
            "The dashed line is the normal distribution of the same mean and spread.",
            figures.residual_histogram(residuals),
        ),
        (
            "autocorrelation",
            "Autocorrelation of the residuals",
            "Inside the grey band the residuals are white noise; outside it the formal errors are too small.",
            figures.residual_autocorrelation(residuals),
        ),
    ]
    if residuals.corrected_base_nt is not None:
        caption = "Two hemispheres of the sensor's base frame, equal area; blank regions were never seen."
        sphere = figures.residual_sphere(residuals.corrected_base_nt, scalar)
        plates.append(("sphere", "Residual on the body sphere", caption, sphere))
    if residuals.r_itrf_km is not None:
        caption = (
            "Geocentric latitude and longitude of the satellite, lines of equal |B| (nT) at its height; "
            "a regional pattern points at the field model."
        )
        earth = figures.residual_map(residuals.t_utc, residuals.r_itrf_km, scalar)
        plates.append(("map", "Residual over the Earth", caption, earth))
    return plates


def _sized_json(figure: Figure) -> str:
    figure.update_layout(width=FIGURE_WIDTH)
    return script_json(str(figure.to_json()))


def _words(value: object) -> str:
    """Return an option's value as people write it."""
    if isinstance(value, list):
        return ", ".join(map(_words, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else str(value)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(loader=PackageLoader("app.reporting"), autoescape=True, undefined=StrictUndefined)
    made.filters["digits"] = lambda value, digits: "–" if value is None else f"{value:,.{digits}f}"
    made.filters["day"] = lambda text: text.replace("T", " ")[:19] + " UTC"
    made.filters["rows"] = lambda matrix, digits: (np.round(np.array(matrix), digits) + 0.0).tolist()
    made.filters["words"] = _words
    return made
