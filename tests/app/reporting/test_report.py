"""The report: everything a review asks for, in one file that reaches nothing, and true to the record."""

import json
import re
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from app.cli.main import magcal
from app.records.parameter_set import ParameterSetRecord, parameter_set_record
from app.records.residual_table import read_residuals
from app.reporting.report import BROWSERS, command_line, parameter_rows, render_report
from magcal_core.calibration.result import Calibration
from magcal_core.errors import InputError, TelemetryFormatError
from magcal_core.pipeline import calibrate
from magcal_core.telemetry import read_samples

SECTIONS = ["Inputs", "Model", "Method", "Results and uncertainty", "Observability", "Figures", "Provenance"]


@pytest.fixture(scope="module")
def nominal(data_dir: Path) -> Calibration:
    return calibrate(read_samples(data_dir / "calibration" / "nominal.csv"))


@pytest.fixture(scope="module")
def record(nominal: Calibration) -> ParameterSetRecord:
    return parameter_set_record(json.loads(json.dumps(nominal.to_dict())))


@pytest.fixture(scope="module")
def page(nominal: Calibration, record: ParameterSetRecord) -> str:
    return render_report(record, nominal.residuals, made_at="2026-11-22 10:00:00 UTC")


def without_scripts(page: str) -> str:
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_the_verdict_stands_before_every_number(page: str, record: ParameterSetRecord) -> None:
    text = without_scripts(page)
    reason = record["verdict"]["reasons"][0]
    assert text.index(reason) < text.index("residual RMS before")
    assert text.index('<section class="verdict accept"') < text.index(reason)


def test_every_section_of_a_review_is_there_in_order(page: str) -> None:
    text = without_scripts(page)
    places = [text.index(f"<h2>{name}</h2>") for name in SECTIONS]
    assert places == sorted(places)


def test_every_parameter_stands_with_both_of_its_errors(page: str, record: ParameterSetRecord) -> None:
    text = without_scripts(page)
    for row in parameter_rows(record):
        cells = [f'<td class="n">{value}</td>' for value in (row.value, row.honest, row.formal)]
        assert f">{row.name}</code>" in text
        assert all(cell in text for cell in cells)


def test_the_file_loads_nothing(page: str) -> None:
    text = without_scripts(page)
    assert not re.search(r"(src|href)\s*=|@import|url\(", text)
    opening = re.findall(r"<script([^>]*)>", page.replace("\n", " "))
    assert all("src" not in attributes for attributes in opening)


def test_the_figures_are_complete_and_the_map_is_left_out_where_no_position_is_known(page: str) -> None:
    plates = re.findall(r'data-plate="plate-([a-z-]+)">(.*?)</script>', page, re.DOTALL)
    names = [name for name, _ in plates]
    assert names == ["before-after", "residual-time", "histogram", "autocorrelation", "sphere", "correlation"]
    assert all(json.loads(content)["data"] for _, content in plates)


def test_the_record_inside_the_file_is_the_record(page: str, record: ParameterSetRecord) -> None:
    found = re.search(r'id="parameter-set">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    assert json.loads(found[1]) == record


def test_text_of_others_cannot_become_markup(record: ParameterSetRecord) -> None:
    hostile = parameter_set_record(
        record | {"satellite": "<img src=x onerror=alert(1)>", "magnetometer": "m", "warnings": ["</script><b>"]}
    )
    page = render_report(hostile)
    assert "<img src=x" not in page
    assert "</script><b>" not in page


def test_a_report_without_residuals_says_so(record: ParameterSetRecord) -> None:
    assert "The residuals of the samples were not given" in render_report(record)


def test_the_command_repeats_the_options(nominal: Calibration) -> None:
    document = json.loads(json.dumps(nominal.to_dict()))
    document["orbit_model"] = "sgp4"
    document["provenance"]["options"] |= {"regressors": ["temperature", "coil"], "robust": "huber"}
    line = command_line(parameter_set_record(document))
    assert line.startswith("magcal calibrate TELEMETRY --tle TLE --method scalar --orbit sgp4 --field igrf")
    assert "--robust huber" in line
    assert "--regressors temperature,coil" in line


def test_what_is_no_parameter_set_is_refused_by_its_fields(record: ParameterSetRecord) -> None:
    with pytest.raises(InputError) as caught:
        parameter_set_record({name: value for name, value in record.items() if name != "verdict"})
    assert [fault.where for fault in caught.value.faults] == ["verdict"]


@pytest.mark.parametrize("form", ["csv", "parquet", "json", "ndjson"])
def test_a_residual_table_is_read_back_from_every_format(form: str, data_dir: Path, tmp_path: Path) -> None:
    """Written by `magcal calibrate --residuals`; CSV keeps 64-bit floats in full, so the tables are equal."""
    target = tmp_path / f"residuals.{form}"
    source = data_dir / "calibration" / "nominal.csv"
    ran = CliRunner().invoke(magcal, ["calibrate", str(source), "--json", "--residuals", str(target)])
    assert ran.exit_code == 0, ran.output
    table = read_residuals(target.read_bytes(), form)
    rms = json.loads(ran.stdout)["statistics"]["after"]["rms_nt"]
    assert float((table.residual_nt**2).mean()) ** 0.5 == pytest.approx(rms, rel=1e-12)
    assert table.corrected_base_nt is not None
    assert len(table.t_utc) == 575


def test_another_table_is_refused_by_the_missing_column() -> None:
    with pytest.raises(TelemetryFormatError, match="no column corrected_nt"):
        read_residuals(b"time,bx\n2022-01-01T00:00:00Z,1\n", "csv")


def test_the_command_writes_a_report_from_files(data_dir: Path, tmp_path: Path) -> None:
    result, residuals, target = (tmp_path / name for name in ("result.json", "residuals.parquet", "report.html"))
    source = str(data_dir / "calibration" / "nominal.csv")
    made = CliRunner().invoke(magcal, ["calibrate", source, "-o", str(result), "--residuals", str(residuals)])
    assert made.exit_code == 0, made.output
    ran = CliRunner().invoke(magcal, ["report", str(result), "--residuals", str(residuals), "-o", str(target)])
    assert ran.exit_code == 0, ran.output
    assert ran.output.strip() == str(target)
    assert "plate-before-after" in target.read_text(encoding="utf-8")


def test_neither_a_file_nor_an_id_is_wrong_usage(tmp_path: Path) -> None:
    ran = CliRunner().invoke(magcal, ["report", str(tmp_path / "missing.json")])
    assert ran.exit_code == 2
    assert "neither a file nor an id" in ran.output


@pytest.mark.browser
def test_the_report_prints_to_pdf(page: str, tmp_path: Path) -> None:
    from app.reporting.report import print_pdf

    assert any(map(shutil.which, BROWSERS)), "no Chromium is installed; `make system` installs one"
    target = tmp_path / "report.pdf"
    print_pdf(page, target)
    content = target.read_bytes()
    assert content.startswith(b"%PDF-")
    assert 3 <= len(re.findall(rb"/Type\s*/Page\b", content)) <= 10
