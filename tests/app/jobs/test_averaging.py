"""A magnetometer that averages, over HTTP: said once of the magnetometer, used by its calibrations, told in the set."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from app.cli.main import magcal
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, tle_text
from magcal_core.simulation.telemetry import simulate
from magcal_core.telemetry import write_samples
from tests.app.jobs.test_jobs import calibrate, send, wait

PASS = SESSIONS[0]
PARTS = 20
PLAIN = {"robust": "none", "noise_model": "none", "time_offset": "none", "locked_terms": "none", "bias_steps": "none"}


@pytest.fixture(scope="module")
def spinning() -> Samples:
    """Ten minutes at 25 deg/s, a reading a second over the whole second about its stamp."""
    made = simulate(
        Sgp4Orbit.from_tle("\n".join(tle_text().splitlines()[:3])), PASS.sensor, PASS.start_utc, 600.0, 1.0 / PARTS,
        rate_deg_s=(14.0, -10.0, 18.0), moments=(0.05, 0.04, 0.06), seed=3,
    )  # fmt: skip
    middles = np.arange(PARTS, len(made.samples) - PARTS, PARTS)
    weights = np.r_[0.5, np.ones(PARTS - 1), 0.5] / PARTS
    h_nt = np.einsum("k,nkj->nj", weights, made.samples.h_nt[middles[:, None] + np.arange(-10, 11)])
    every = made.samples.take(middles)
    return replace(every, h_nt=h_nt + 20.0 * np.random.default_rng(3).normal(size=h_nt.shape))


@pytest.fixture
def session_id(api, satellite, spinning) -> str:
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    return send(api, satellite, write_samples(spinning, "csv"))


def parameter_set(api, asked) -> dict:
    job = wait(api, asked.raise_for_status().json()["id"])
    assert job["state"] == "succeeded", job
    return api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()


def worst_scale_error(record: dict) -> float:
    return float(np.abs(np.array(record["parameters"]["scale"]) / PASS.sensor.scale - 1.0).max())


def test_what_a_magnetometer_says_its_calibrations_use_and_a_job_may_say_otherwise(api, satellite, session_id):
    """A second at 25 deg/s makes scale factors 0.5 % too small; a job that says 0 s has them so."""
    where = f"/satellites/{satellite}/magnetometers/mgm"
    assert api.get(where).json()["integration_s"] is None
    assert api.patch(where, json={"integration_s": 1.0}).json()["integration_s"] == 1.0
    used = parameter_set(api, calibrate(api, [session_id], **PLAIN))
    assert used["provenance"]["options"]["integration_s"] == 1.0
    assert used["averaging"]["is_used"]
    assert used["averaging"]["rate_from"] == "quaternions"
    assert worst_scale_error(used) < 1e-3
    other = parameter_set(api, calibrate(api, [session_id], **PLAIN, integration_s=0))
    assert other["provenance"]["options"]["integration_s"] == 0.0
    assert "averaging" not in other
    assert worst_scale_error(other) > 3e-3
    residual = [
        api.get(f"/sessions/{session_id}/residual", params={"parameter_set": one["id"]}).json()["rms_nt"]
        for one in (used, other)
    ]
    assert residual[0] < 0.8 * residual[1]
    again = api.post("/reprocessings", json={"satellites": [satellite]} | PLAIN).raise_for_status().json()
    (part,) = api.get("/jobs", params={"session": session_id, "kind": "calibration", "limit": 1}).json()["items"]
    assert part["parent_id"] == again["id"]
    assert part["options"]["integration_s"] == 1.0


@pytest.mark.parametrize("value", [-0.1, 60.5, "1"])
def test_an_integration_time_that_cannot_be_is_refused_at_once(api, satellite, value):
    body = {"id": "m", "unit": "nT", "integration_s": value}
    assert api.post(f"/satellites/{satellite}/magnetometers", json=body).status_code == 422
    where = f"/satellites/{satellite}/magnetometers/mgm"
    assert api.patch(where, json={"integration_s": value}).status_code == 422


def test_the_command_line_takes_it_and_the_set_s_command_repeats_it(spinning, tmp_path):
    from app.reporting.report import command_line

    for name, content in (("pass.csv", write_samples(spinning, "csv")), ("pass.tle", tle_text().encode())):
        (tmp_path / name).write_bytes(content)
    asked = ["calibrate", str(tmp_path / "pass.csv"), "--tle", str(tmp_path / "pass.tle"), "--json"]
    asked += [part for name, value in PLAIN.items() for part in (f"--{name.replace('_', '-')}", value)]
    done = CliRunner().invoke(magcal, [*asked, "--integration", "1"])
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["averaging"]["is_used"]
    assert worst_scale_error(record) < 1e-3
    assert "--integration 1.0" in command_line(record)
    refused = CliRunner().invoke(magcal, [*asked, "--integration", "90"])
    assert refused.exit_code == 2
    assert "integration" in refused.output
