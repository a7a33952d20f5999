"""The trend in the report: over HTTP, on the command line from a service and from files, and where there is none."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import httpx2
import pytest
from click.testing import CliRunner

from app.cli.main import magcal
from tests.app.test_trends import keep
from tests.magcal_core.calibration.sessions.histories import history

PATIENCE_S = 120.0


def section(page: str) -> str:
    """Return the words of the section, empty where the report has none."""
    text = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    found = re.search(r"<h2>The sensor in time</h2>(.*?)<h2>", text, re.DOTALL)
    return "" if found is None else " ".join(re.sub(r"<[^>]+>", " ", found[1]).split())


def calibrated(api: httpx2.Client, satellite: str, telemetry: Path) -> str:
    """Return the parameter set that a worker makes of a file."""
    where = f"/satellites/{satellite}/sessions?magnetometer=mgm"
    sent = api.post(where, content=telemetry.read_bytes(), headers={"Content-Type": "text/csv"}).raise_for_status()
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [sent.json()["id"]]}).raise_for_status().json()
    deadline = time.monotonic() + PATIENCE_S
    while job["state"] in {"queued", "running"}:
        assert time.monotonic() < deadline
        time.sleep(0.1)
        job = api.get(f"/jobs/{job['id']}").json()
    assert job["state"] == "succeeded", job
    return str(job["result"]["parameter_set_id"])


@pytest.mark.parametrize("from_where", ["http", "command"])
def test_a_report_from_the_service_has_the_trend_and_says_where_there_is_none(
    *, service, api, satellite, data_dir, tmp_path, from_where
):
    """The words and the figure are those of the trend's own addresses."""
    made = calibrated(api, satellite, data_dir / "calibration" / "nominal.csv")

    def report() -> str:
        if from_where == "http":
            return api.get(f"/parameter-sets/{made}/report").raise_for_status().text
        target = tmp_path / "report.html"
        where = ["--url", str(api.base_url).removesuffix("/").removesuffix("/api/v1"), "--key", service.key("read")]
        ran = CliRunner().invoke(magcal, ["report", made, "-o", str(target), *where])
        assert ran.exit_code == 0, ran.output
        return target.read_text(encoding="utf-8")

    first = report()
    assert section(first).startswith("How the parameters move in time cannot be told: ")
    refused = api.get(f"/satellites/{satellite}/magnetometers/mgm/trend")
    assert (refused.status_code, refused.json()["code"]) == (409, "too_few_sets")
    assert refused.json()["detail"] in section(first)
    assert 'id="plate-trend"' not in first

    jumped = history(21, 9, walk_nt=60.0, jump=(5, (700.0, -200.0, 100.0))).sets
    with service.database.write() as session:
        kept = [keep(session, {"satellite_id": satellite, "magnetometer_id": "mgm"}, one) for one in jumped]
    trend = api.get(f"/satellites/{satellite}/magnetometers/mgm/trend").raise_for_status().json()
    page = report()
    text = section(page)
    assert trend["life"]["text"] in text
    assert kept[-1] in text
    assert trend["jumps"]
    for jump in trend["jumps"]:
        assert jump["text"] in text
    for one in trend["left_out"]:
        assert one["parameter_set_id"] in text
    drawn = json.loads(re.search(r'data-plate="plate-trend">(.*?)</script>', page, re.DOTALL)[1])
    figure = api.get(f"/satellites/{satellite}/figures/trend", params={"magnetometer": "mgm"}).json()
    assert drawn["data"] == figure["data"]


def test_a_report_from_files_has_the_trend_of_the_sets_that_are_given(data_dir: Path, tmp_path: Path) -> None:
    result, sets, target = (tmp_path / name for name in ("result.json", "sets.json", "report.html"))
    source = str(data_dir / "calibration" / "nominal.csv")
    made = CliRunner().invoke(magcal, ["calibrate", source, "-o", str(result)])
    assert made.exit_code == 0, made.output
    sets.write_text(json.dumps(history(7, 8, alone=(4, 1500.0)).sets), encoding="utf-8")

    def report(*more: str) -> str:
        ran = CliRunner().invoke(magcal, ["report", str(result), "-o", str(target), *more])
        assert ran.exit_code == 0, ran.output
        return target.read_text(encoding="utf-8")

    page = report("--trend", str(sets))
    told = CliRunner().invoke(magcal, ["trend", str(sets), "--json"])
    assert json.loads(told.output)["life"]["text"] in section(page)
    assert "set-004 : outlier" in section(page)
    assert 'id="plate-trend"' in page
    without = report()
    assert section(without) == ""
    assert 'id="plate-trend"' not in without
