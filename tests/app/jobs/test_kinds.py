"""Attitude simulations and energy balances as jobs: the same numbers as the commands, within the caller's reach."""

import csv
import io
import json
import time

import httpx2
import numpy as np
import pytest

from app.jobs.kinds.attitude_simulation import AttitudeBody
from app.jobs.kinds.energy_balance import EnergyBody
from magcal_core.attitude.options import RomOptions
from magcal_core.energy.options import EnergyOptions
from magcal_core.simulation.dekart_mission import tle_text

ENDED = {"succeeded", "failed", "cancelled"}
STATE = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "J2000",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}
"""DEKART, 19 February 2022."""
RAW = {"bias_nt": [2000.0, -1500.0, 900.0], "scale": [1.02, 0.99, 1.01], "nonorthogonality_deg": [0.5, -0.3, 0.2]}


def wait(api: httpx2.Client, answer: httpx2.Response, timeout_s: float = 120.0) -> dict:
    """Return the job once it has ended."""
    assert answer.status_code == 202, answer.text
    deadline = time.monotonic() + timeout_s
    while True:
        job = api.get(f"/jobs/{answer.json()['id']}").json()
        if job["state"] in ENDED:
            return job
        assert time.monotonic() < deadline, job
        time.sleep(0.05)


def ask(api: httpx2.Client, kind: str, **options: object) -> httpx2.Response:
    return api.post("/jobs", json={"kind": kind, **options})


def send_tle(api: httpx2.Client, satellite: str) -> list[str]:
    headers = {"content-type": "text/plain"}
    answer = api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers=headers)
    return [one["id"] for one in answer.json()["items"]]


def test_the_published_restoration_comes_out_of_a_job(api):
    """attitude of (110, -130, 170) deg at 62 deg: below 5 deg at 3380 s, below 1 deg at 5630 s, 3 % (ROM, figure 1)."""
    job = wait(api, ask(api, "attitude-simulation", inclination_deg=62, start=[110, -130, 170], duration_s=10_000))
    assert (job["state"], job["error"]) == ("succeeded", None)
    result = job["result"]
    assert result["settling_s"]["5"] == pytest.approx(3380, rel=0.03)
    assert result["settling_s"]["1"] == pytest.approx(5630, rel=0.03)
    assert result["final_error_deg"] < 0.01
    wanted = {"max_error_last_two_orbits_deg", "max_rate_error_deg_s", "wheel_momentum_max_nms", "gains"}
    assert wanted <= set(result)
    assert (job["options"]["inclination_deg"], job["options"]["start_deg"]) == (62, [110, -130, 170])


def test_series_are_thinned_and_come_in_every_table_format(api):
    job = wait(api, ask(api, "attitude-simulation", start=[30, 20, 10], duration=4000))
    told = job["result"]["series"]
    assert told["rows"] <= 2000
    columns = api.get(f"/jobs/{job['id']}/series").json()
    assert list(columns) == told["columns"]
    assert (columns["t_s"][0], columns["t_s"][-1]) == (0, 4000)
    assert columns["error_deg"][-1] == job["result"]["final_error_deg"]
    text = api.get(f"/jobs/{job['id']}/series", headers={"accept": "text/csv"}).text
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == told["rows"]
    assert float(rows[-1]["error_deg"]) == pytest.approx(columns["error_deg"][-1], rel=1e-12)
    assert api.get(f"/jobs/{job['id']}/series?format=parquet").content[:4] == b"PAR1"


def test_a_satellite_gives_the_orbit_that_is_not_given(api, satellite):
    """The DEKART TLE: 97.7 deg, 15.04 revolutions a day, so 6938 km less 6378 km; 15 km of short-period motion."""
    send_tle(api, satellite)
    job = wait(api, ask(api, "attitude-simulation", satellite=satellite, field="igrf", duration_s=600))
    assert job["satellite"] == satellite
    assert job["options"]["altitude_km"] == pytest.approx(560, abs=15)
    assert job["options"]["inclination_deg"] == pytest.approx(97.72, abs=0.1)


def test_a_raw_magnetometer_points_worse_than_a_corrected_one(api):
    common = {"field": "igrf", "start": [10, 10, 10], "duration_s": 20_000, "dt_s": 2.0}
    jobs = [ask(api, "attitude-simulation", **common, sensor=RAW, **more) for more in ({}, {"corrected_with": RAW})]
    raw, corrected = (wait(api, job)["result"]["max_error_last_two_orbits_deg"] for job in jobs)
    assert raw > 2.0
    assert corrected < 1.0


def test_a_parameter_set_is_found_by_its_id_within_reach(service, api, satellite, data_dir):
    content = (data_dir / "calibration" / "nominal.csv").read_bytes()
    path, headers = f"/satellites/{satellite}/sessions?magnetometer=mgm", {"content-type": "text/csv"}
    session_id = api.post(path, content=content, headers=headers).json()["id"]
    found = wait(api, ask(api, "calibration", session_ids=[session_id]))["result"]["parameter_set_id"]
    parameters = api.get(f"/parameter-sets/{found}").json()["parameters"]
    answer = ask(api, "attitude-simulation", sensor=found, corrected_with=found, duration_s=600)
    job = wait(api, answer)
    assert (job["satellite"], job["options"]["sensor_set"]) == (satellite, found)
    assert job["options"]["sensor"] == {name: parameters[name] for name in RAW}
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        assert ask(bound, "attitude-simulation", sensor=found).status_code == 404
        assert ask(bound, "attitude-simulation", satellite=satellite).status_code == 404
        assert bound.get(f"/jobs/{job['id']}/series").status_code == 404


def test_parameter_sets_of_another_satellite_do_not_mix(api, satellite, names):
    other = next(names)
    api.post("/satellites", json={"id": other})
    refused = ask(api, "attitude-simulation", satellite=other, sensor="0" * 32)
    assert refused.status_code == 404


@pytest.mark.parametrize(
    "wrong",
    [
        {"inclination_deg": 200},
        {"start": [1, 2]},
        {"field": "wmm-1900"},
        {"form": "third"},
        {"duration_s": 0},
        {"duration_s": 1e7, "dt_s": 0.5},
        {"sensor": {"bias_nt": [1, 2, 3]}},
        {"epoch": "2020-01-01T00:00:00"},
        {"unknown": 1},
    ],
)
def test_attitude_options_that_cannot_be_are_refused_at_once(api, wrong):
    refused = ask(api, "attitude-simulation", **wrong)
    assert refused.status_code == 422, refused.text
    assert refused.json()["errors"]


def test_the_energy_of_a_day_is_conserved_in_a_job(api):
    """Standard deviation 0.019, peak to peak 0.072 m2/s2: the published figures for this orbit."""
    job = wait(api, ask(api, "energy-balance", orbit=STATE, duration_s=86400, step_s=60))
    assert (job["state"], job["error"]) == ("succeeded", None)
    balance = job["result"]["hamiltonian"]
    assert balance["std_m2_s2"] == pytest.approx(0.019, abs=0.001)
    assert balance["peak_to_peak_m2_s2"] == pytest.approx(0.072, abs=0.003)
    assert {"kinetic", "sun", "moon", "tidal_work"} <= set(job["result"]["terms"])
    columns = api.get(f"/jobs/{job['id']}/series").json()
    assert len(columns["time"]) == job["result"]["series"]["rows"] == 1441
    assert np.std(columns["hamiltonian_m2_s2"]) == pytest.approx(balance["std_m2_s2"], rel=1e-6)


def test_an_orbit_that_is_kept_is_balanced_by_its_id(service, api, satellite):
    orbit_id = send_tle(api, satellite)[0]
    short = {"duration_s": 3600, "step_s": 60}
    by_id = wait(api, ask(api, "energy-balance", orbit=orbit_id, **short))
    assert (by_id["satellite"], by_id["options"]["orbit_id"]) == (satellite, orbit_id)
    content = api.get(f"/satellites/{satellite}/orbits/{orbit_id}").json()["content"]
    inline = wait(api, ask(api, "energy-balance", tle=content, **short))
    assert inline["result"]["hamiltonian"] == by_id["result"]["hamiltonian"]
    newest = wait(api, ask(api, "energy-balance", satellite=satellite, propagator="sgp4", **short))
    assert newest["result"]["warnings"]
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        assert ask(bound, "energy-balance", orbit=orbit_id).status_code == 404
        assert ask(bound, "energy-balance", satellite=satellite).status_code == 404


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"state": STATE, "tle": "x"},
        {"state": STATE, "degree": 99},
        {"state": STATE, "step_s": 0},
        {"state": STATE | {"frame": "MOON"}},
        {"state": STATE | {"position_km": [1, 2, 3]}},
        {"state": STATE, "form": "third"},
        {"tle": "1 garbage\n2 garbage\n"},
        {"state": STATE, "unknown": 1},
    ],
)
def test_energy_options_that_cannot_be_are_refused_at_once(api, wrong):
    refused = ask(api, "energy-balance", **wrong)
    assert refused.status_code == 422, refused.text
    assert refused.json()["errors"]


def test_a_running_simulation_is_cancelled(api):
    """Ten simulations of the longest kind wait one behind the other; the last is cancelled while they run."""
    longest = {"duration_s": 999_999, "dt_s": 1.0, "field": "igrf"}
    jobs = [ask(api, "attitude-simulation", **longest).json()["id"] for _ in range(2)]
    for job_id in jobs:
        assert api.post(f"/jobs/{job_id}/cancel").status_code == 202
    deadline = time.monotonic() + 30
    while any(api.get(f"/jobs/{job_id}").json()["state"] not in ENDED for job_id in jobs):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert {api.get(f"/jobs/{job_id}").json()["state"] for job_id in jobs} == {"cancelled"}


def test_a_job_without_series_says_so(new_service):
    service = new_service(workers=0)
    with service.client() as api:
        job = ask(api, "attitude-simulation", duration_s=600).json()
        assert api.get(f"/jobs/{job['id']}/series").status_code == 404


def test_the_requests_have_every_option():
    assert set(RomOptions.__slots__) <= set(AttitudeBody.model_fields)
    assert set(EnergyOptions.__slots__) <= set(EnergyBody.model_fields)


def test_the_documentation_tells_the_kinds_apart(service):
    with httpx2.Client(base_url=service.url, trust_env=False) as root:
        text = json.dumps(root.get("/openapi.json").json())
    assert all(kind in text for kind in ("attitude-simulation", "energy-balance", "AttitudeBody", "EnergyBody"))
