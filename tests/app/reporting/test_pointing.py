"""What a parameter set buys, over HTTP and in the report: attitude by magnetometer, raw and corrected."""

import json
import threading
import time
from pathlib import Path

import httpx2
import pytest
from click.testing import CliRunner

from app.cli.main import magcal
from app.records.parameter_set import ParameterSetRecord, parameter_set_record
from app.reporting.pointing import circle, pointing_of
from app.reporting.report import render_report
from magcal_core.errors import InputError
from magcal_core.pipeline import calibrate
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import read_samples, write_samples


@pytest.fixture(scope="module")
def record(data_dir: Path) -> ParameterSetRecord:
    found = calibrate(read_samples(data_dir / "calibration" / "nominal.csv")).to_dict()
    return parameter_set_record(json.loads(json.dumps(found)))


def calibrated(api: httpx2.Client, satellite: str, method: str) -> str:
    telemetry = write_samples(simulated(SESSIONS[0]).samples, "csv")
    path, headers = f"/satellites/{satellite}/sessions?magnetometer=mgm", {"content-type": "text/csv"}
    session_id = api.post(path, content=telemetry, headers=headers).json()["id"]
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id], "method": method}).json()
    while job["state"] in {"queued", "running"}:
        time.sleep(0.05)
        job = api.get(f"/jobs/{job['id']}").json()
    return job["result"]["parameter_set_id"]


@pytest.fixture
def sets(api: httpx2.Client, satellite: str) -> list[str]:
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    return [calibrated(api, satellite, method) for method in ("scalar", "vector")]


def test_a_calibration_points_better_than_the_raw_sensor_on_the_satellite_s_own_orbit(service, api, sets):
    """The DEKART orbit: 560 km (15 km of short-period motion) at 97.7 deg; a perfect sensor leaves 0.17 deg (ROM)."""
    alone = api.get(f"/parameter-sets/{sets[0]}/pointing").json()
    (orbit,) = alone["orbits"]
    assert (alone["parameter_set_id"], alone["active_id"], orbit["active"]) == (sets[0], None, None)
    assert orbit["altitude_km"] == pytest.approx(560, abs=15)
    assert orbit["inclination_deg"] == pytest.approx(97.7, abs=0.1)
    assert orbit["ideal"]["max_error_deg"] == pytest.approx(0.17, abs=0.03)
    assert orbit["raw"]["max_error_deg"] > 5 * orbit["calibrated"]["max_error_deg"]
    api.post(f"/parameter-sets/{sets[1]}/activate?force=true").raise_for_status()
    beside = api.get(f"/parameter-sets/{sets[0]}/pointing").json()
    assert beside["active_id"] == sets[1]
    assert beside["orbits"][0]["calibrated"] == orbit["calibrated"]
    assert beside["orbits"][0]["active"]["max_error_deg"] > 0
    asked = api.get(f"/parameter-sets/{sets[0]}/pointing?altitude_km=700&inclination_deg=51.6").json()["orbits"][0]
    assert (asked["altitude_km"], asked["inclination_deg"]) == (700, pytest.approx(51.6))
    assert api.get(f"/parameter-sets/{sets[0]}/pointing?inclination_deg=200").status_code == 422
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        assert bound.get(f"/parameter-sets/{sets[0]}/pointing").status_code == 404
    page = api.get(f"/parameter-sets/{sets[0]}/report?pointing=true").text
    assert "corrected with the set in force" in page
    assert "Pointing impact" not in api.get(f"/parameter-sets/{sets[0]}/report").text


def test_many_who_ask_the_same_get_the_same(api, sets):
    answers = []
    path = f"/parameter-sets/{sets[1]}/pointing?inclination_deg=45"
    threads = [threading.Thread(target=lambda: answers.append(api.get(path).text)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(answers)) == 1
    assert "calibrated" in answers[0]


def test_without_an_orbit_two_are_tried(record: ParameterSetRecord) -> None:
    found = pointing_of(record)
    assert [(one["altitude_km"], round(one["inclination_deg"], 1)) for one in found["orbits"]] == [
        (500, 62),
        (500, 97.7),
    ]
    text = render_report(record, pointing=found)
    assert f"{found['orbits'][1]['raw']['max_error_deg']:.2f}" in text


def test_a_set_without_a_covariance_says_nothing_of_pointing(record: ParameterSetRecord) -> None:
    unknown = parameter_set_record(
        record | {"covariance": [[None] * 9] * 9, "parameter_names": record["parameter_names"][:9]}
    )
    with pytest.raises(InputError, match="covariance"):
        pointing_of(unknown, orbits=[circle(500.0, 62.0)])


def test_the_report_command_adds_the_section_where_it_is_asked_for(record: ParameterSetRecord, tmp_path: Path) -> None:
    result, page = tmp_path / "result.json", tmp_path / "report.html"
    result.write_text(json.dumps(record))
    done = CliRunner().invoke(magcal, ["report", str(result), "--pointing", "-o", str(page)])
    assert done.exit_code == 0, done.output
    assert "Pointing impact" in page.read_text()
