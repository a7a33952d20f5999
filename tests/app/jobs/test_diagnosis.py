"""Why a calibration failed, over HTTP: the cause in the job's problem, orbits that may be tried, and gyros."""

from __future__ import annotations

from dataclasses import replace

import httpx2
import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix
from magcal_core.orbit.messages.tle import checksum
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, tle_of
from magcal_core.simulation.telemetry import Disturbances, simulate
from magcal_core.telemetry import write_samples
from tests.app.jobs.test_jobs import calibrate, send, wait

TEXT = {"content-type": "text/plain"}
PASS = SESSIONS[0]
GYROS = ("wx", "wy", "wz")


def keep(api: httpx2.Client, satellite: str, text: str) -> list[str]:
    """Return the ids of the orbits in ``text``."""
    answer = api.post(f"/satellites/{satellite}/orbits", content=text, headers=TEXT).raise_for_status().json()
    rows = answer if isinstance(answer, list) else answer["items"]
    return [row["id"] for row in rows]


def ended(api: httpx2.Client, asked: httpx2.Response) -> dict:
    """Return the job once it has ended; a diagnosis with all its scans takes some seconds."""
    return wait(api, asked.raise_for_status().json()["id"], timeout_s=240.0)


def tle(*, node_deg: float = 0.0, anomaly_deg: float = 0.0, days: float = 0.0) -> str:
    """Return the session's TLE with its plane, its place and its epoch moved: another object's."""
    known = tle_of(PASS)
    first = f"{known.line1[:18]}{float(known.line1[18:32]) + days:014.8f}{known.line1[32:68]}"
    node, anomaly = (known.raan_deg + node_deg) % 360.0, (known.mean_anomaly_deg + anomaly_deg) % 360.0
    second = f"{known.line2[:17]}{node:8.4f}{known.line2[25:43]}{anomaly:8.4f}{known.line2[51:68]}"
    return "".join(f"{line}{checksum(line)}\n" for line in (first, second))


OWN = tle(days=-0.5)
"""The orbit that the session was flown on: half a day old."""
ANOTHER = tle(node_deg=70.0, anomaly_deg=140.0)


@pytest.fixture(scope="module")
def flown() -> Samples:
    """700 samples of 10 s without attitude, with the rates of the gyros, deg/s, along the magnetometer's base axes."""
    disturbances = Disturbances(noise_nt=60.0)
    made = simulate(
        Sgp4Orbit.from_tle(OWN), PASS.sensor, PASS.start_utc, 7000.0, 1.0, disturbances=disturbances, seed=4
    )
    every = made.samples
    turn = attitude_matrix(every.q_base_gcrf)
    # C(t + 1) C(t - 1)^T = exp(-[2 s w x]): the antisymmetric part is -sin|2 s w| of the axis.
    step = np.einsum("nij,nkj->nik", turn[2:], turn[:-2])
    axial = np.stack([step[:, 1, 2] - step[:, 2, 1], step[:, 2, 0] - step[:, 0, 2], step[:, 0, 1] - step[:, 1, 0]], 1)
    rates = np.rad2deg(axial / 2.0) / 2.0
    rows = np.arange(10, len(every) - 10, 10)
    noise = np.random.default_rng(4).normal(scale=0.01, size=(len(rows), 3))
    columns = dict(zip(GYROS, (rates[rows - 1] + noise).T, strict=True))
    return replace(every.take(rows), q_base_gcrf=None, housekeeping=columns)


def test_the_problem_of_a_failed_job_has_its_cause(api, satellite, flown):
    """Local time of a zone two hours ahead: the clock, in the job, in the list of jobs, and in what needs attention."""
    keep(api, satellite, OWN)
    shifted = replace(flown, t_utc=flown.t_utc + np.timedelta64(7200, "s"))
    session = send(api, satellite, write_samples(shifted, "csv"))
    job = ended(api, calibrate(api, [session]))
    assert job["state"] == "failed", job
    error = job["error"]
    assert error["code"] == "wrong_input"
    assert error["detail"].startswith("clock: ")
    assert "local time taken for UTC?" in error["detail"]
    found = error["diagnosis"]["findings"][0]
    assert (found["code"], found["unit"]) == ("clock", "s")
    assert found["value"] == pytest.approx(-7200.0, abs=20.0)
    assert error["diagnosis"]["residual_share"] > 0.02
    assert {one["code"] for one in error["diagnosis"]["candidates"]} >= {"clock", "along_track"}
    assert error["data_quality"]["rows"] == len(flown)
    listed = api.get("/jobs", params={"session": session, "kind": "calibration", "limit": 1}).json()["items"]
    assert listed[0]["error"] == error


def test_candidate_orbits_are_tried_by_the_diagnosis_alone(api, satellite, flown):
    """The orbit that is used is of another object; the right one is too old to be used, and may be named."""
    (own,) = keep(api, satellite, OWN)
    keep(api, satellite, ANOTHER)
    session = send(api, satellite, write_samples(flown, "csv"))
    near = {"max_orbit_age_days": 0.2, "time_offset": "none"}
    alone = ended(api, calibrate(api, [session], **near))
    assert alone["state"] == "failed", alone
    assert alone["error"]["diagnosis"]["findings"][0]["code"] != "wrong_satellite"
    job = ended(api, calibrate(api, [session], **near, candidate_orbits=[own]))
    assert job["state"] == "failed", job
    assert job["error"]["diagnosis"]["findings"][0]["code"] == "wrong_satellite"
    assert job["error"]["detail"].startswith("wrong_satellite: the orbit of ")
    assert job["options"]["candidate_orbits"] == [own]


def test_an_orbit_of_another_satellite_is_no_candidate(api, satellite, names, flown):
    other = next(names)
    api.post("/satellites", json={"id": other}).raise_for_status()
    (foreign,) = keep(api, other, tle(node_deg=10.0))
    keep(api, satellite, OWN)
    session = send(api, satellite, write_samples(flown, "csv"))
    for named in (foreign, "0" * 32):
        assert calibrate(api, [session], candidate_orbits=[named]).status_code == 404
    assert calibrate(api, [session], candidate_orbits=["not an id"]).status_code == 422


def test_gyros_tell_the_mounting_over_http(api, satellite, flown):
    """Gyro axes along the magnetometer's base axes: no rotation, to a degree, of a right-handed set."""
    keep(api, satellite, OWN)
    session = send(api, satellite, write_samples(flown, "csv"))
    gyro = {"columns": list(GYROS), "unit": "deg/s"}
    job = ended(api, calibrate(api, [session], gyro=gyro))
    assert job["state"] == "succeeded", job["error"]
    assert job["options"]["gyro"] == gyro
    record = api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()
    found = record["gyro"]
    assert (found["state"], found["handedness"]) == ("resolved", "right"), found
    assert np.linalg.norm(found["rotation_vector_deg"]) < 1.5
    assert record["mounting"]["by"] == "gyro"


@pytest.mark.parametrize(
    "gyro",
    [
        {"columns": ["wx", "wy"], "unit": "deg/s"},
        {"columns": ["wx", "wy", "wz"], "unit": "rpm"},
        {"columns": ["wx", "wy", "wy"]},
        {"unit": "deg/s"},
    ],
)
def test_gyros_that_are_none_are_refused(api, satellite, flown, gyro):
    keep(api, satellite, OWN)
    session = send(api, satellite, write_samples(flown.take(slice(0, 60)), "csv"))
    answer = calibrate(api, [session], gyro=gyro)
    assert answer.status_code == 422
    assert "gyro" in answer.text
