"""`magcal report`: the report of a parameter set, from a file or from a service, as HTML and as PDF."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

if TYPE_CHECKING:
    from app.client.blocking import Client
    from app.records.parameter_set import ParameterSetRecord
    from app.reporting.in_time import SensorInTime
    from app.reporting.pointing import ImpactRecord
    from magcal_core.calibration.residuals import ResidualTable

IDENTIFIER: Final = re.compile(r"[0-9a-f]{32}")
FILE: Final = click.Path(exists=True, dir_okay=False, path_type=Path)

UNTOLD: Final = {"too_few_sets", "option"}
"""Codes with which a service answers that a magnetometer has no trend."""


@click.command("report")
@click.argument("source", metavar="PARAMETER_SET|RESULT.json")
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), default=Path("report.html"),
              show_default=True, help="File to write; one that ends in .pdf is printed.")  # fmt: skip
@click.option(
    "--residuals", type=FILE, help="Residual table of RESULT.json, as `magcal calibrate --residuals` writes it."
)
@click.option("--trend", "history", multiple=True, type=FILE,
              help="Parameter sets of RESULT.json's magnetometer, for their trend; repeatable.")  # fmt: skip
@click.option("--pointing", is_flag=True, help="Add how well attitude by magnetometer would point with it.")
@click.option("--pdf", is_flag=True, help="Print a PDF beside the HTML, through an installed Chromium.")
@click.option("--url", envvar="MAGCAL_URL", default="http://127.0.0.1:8000", show_default=True,
              help="The service that has the parameter set (MAGCAL_URL).")  # fmt: skip
@click.option("--key", envvar="MAGCAL_KEY", help="A key of that service with the scope read (MAGCAL_KEY).")
def command(
    source: str,
    output: Path,
    residuals: Path | None,
    history: tuple[Path, ...],
    pointing: bool,
    pdf: bool,
    url: str,
    key: str | None,
) -> None:
    """Write the report of a parameter set: one HTML file that needs nothing else, fit for a review.

    RESULT.json is what `magcal calibrate --json` printed; give its residuals with --residuals, and the report has their
    figures. PARAMETER_SET is the id of one in a service, whose report has the trend of its magnetometer as well.
    """
    from app.reporting.report import print_pdf, render_report

    impact, in_time = None, _trend_of_files(history)
    if Path(source).is_file():
        record, table = _of_files(Path(source), residuals)
        if pointing:
            from app.reporting.pointing import pointing_of

            impact = pointing_of(record)
    elif IDENTIFIER.fullmatch(source):
        record, table, impact, in_time = _of_service(source, url, key, pointing)
    else:
        raise click.BadParameter(f"{source!r} is neither a file nor an id", param_hint="PARAMETER_SET|RESULT.json")
    made_at = f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
    page = render_report(record, table, made_at=made_at, pointing=impact, in_time=in_time)
    written = []
    if output.suffix.lower() != ".pdf":
        output.write_text(page, encoding="utf-8")
        written.append(output)
    if pdf or output.suffix.lower() == ".pdf":
        target = output.with_suffix(".pdf")
        print_pdf(page, target)
        written.append(target)
    for path in written:
        click.echo(str(path))


def _of_files(result: Path, residuals: Path | None) -> tuple[ParameterSetRecord, ResidualTable | None]:
    from app.records.parameter_set import parse_parameter_set
    from app.records.residual_table import read_residuals
    from magcal_core.telemetry.formats import FORMATS, format_of_name, suffixes_of

    record = parse_parameter_set(result.read_bytes())
    if residuals is None:
        return record, None
    form = format_of_name(residuals)
    if form is None or not FORMATS[form].is_read_back:
        readable = {name: one for name, one in FORMATS.items() if one.is_read_back}
        raise click.BadParameter(f"want a file that ends in {suffixes_of(readable)}", param_hint="--residuals")
    return record, read_residuals(residuals.read_bytes(), form)


def _of_service(
    set_id: str, url: str, key: str | None, pointing: bool
) -> tuple[ParameterSetRecord, ResidualTable, ImpactRecord | None, SensorInTime]:
    import json

    from app.client.blocking import Client
    from app.records.parameter_set import parse_parameter_set
    from app.records.residual_table import read_residuals

    if key is None:
        raise click.UsageError("a service needs a key: --key or MAGCAL_KEY")
    path = f"/parameter-sets/{set_id}"
    with Client(url, key) as service:
        record = parse_parameter_set(service.download(path))
        table = read_residuals(service.download(f"{path}/residuals", format="parquet"), "parquet")
        impact: ImpactRecord | None = json.loads(service.download(f"{path}/pointing")) if pointing else None
        in_time = _trend_of_service(service, record)
    return record, table, impact, in_time


def _trend_of_service(service: Client, record: ParameterSetRecord) -> SensorInTime:
    import json

    from app.client.blocking import ServiceAnswerError
    from app.reporting.in_time import SensorInTime

    satellite, magnetometer = record["satellite"], record["magnetometer"]
    try:
        trend = service.download(f"/satellites/{satellite}/magnetometers/{magnetometer}/trend")
    except ServiceAnswerError as error:
        if error.code not in UNTOLD:
            raise
        return SensorInTime.untold(error.message)
    figure = service.download(f"/satellites/{satellite}/figures/trend", magnetometer=magnetometer)
    return SensorInTime(json.loads(trend), json.loads(figure))


def _trend_of_files(history: tuple[Path, ...]) -> SensorInTime | None:
    if not history:
        return None
    from app.cli.trend import sets_of_file
    from app.reporting.in_time import SensorInTime
    from magcal_core.calibration.sessions.trend import trend

    return SensorInTime.of_trend(trend([one for path in history for one in sets_of_file(path)]))
