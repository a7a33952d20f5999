"""Sessions against parameter sets over HTTP: monitoring, two magnetometers, and several sessions in one calibration."""

import time
from dataclasses import replace

import numpy as np
import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

CSV = {"content-type": "text/csv"}


def sent(api, satellite, samples, magnetometer="mgm") -> str:
    path = f"/satellites/{satellite}/sessions"
    content = write_samples(samples, "csv")
    answer = api.post(path, params={"magnetometer": magnetometer}, content=content, headers=CSV)
    assert answer.status_code in {200, 201}, answer.text
    return answer.json()["id"]


def calibrated(api, session_ids, **options) -> dict:
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": session_ids, **options}).json()
    while job["state"] in {"queued", "running"}:
        time.sleep(0.02)
        job = api.get(f"/jobs/{job['id']}").json()
    assert job["state"] == "succeeded", job["error"]
    return api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()


@pytest.fixture
def flown(api, satellite):
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    return simulated(SESSIONS[0]).samples


def shifted(samples, bias_nt, hours=0):
    return replace(samples, h_nt=samples.h_nt + bias_nt, t_utc=samples.t_utc + np.timedelta64(hours, "h"))


def test_a_session_agrees_with_the_set_made_from_it_and_a_moved_one_does_not(api, satellite, flown):
    """2000 nT on axis 2 are told from the honest error of the set, tens of nT."""
    session_id, moved_id = sent(api, satellite, flown), sent(api, satellite, shifted(flown, [0.0, 2000.0, 0.0]))
    found = calibrated(api, [session_id])
    query = {"parameter_set": found["id"]}
    own = api.get(f"/sessions/{session_id}/monitoring", params=query).json()
    assert (own["grade"], own["parameter_set_id"]) == ("agrees", found["id"])
    assert own["residual_ratio"] == pytest.approx(1.0, abs=0.05)
    moved = api.get(f"/sessions/{moved_id}/monitoring", params=query).json()
    assert moved["grade"] == "disagrees"
    assert moved["drifts"][0]["parameter"] == "bias_nt[1]"
    assert moved["drifts"][0]["difference"] == pytest.approx(2000.0, rel=0.2)


def test_monitoring_takes_the_set_in_force_unless_one_is_named(api, satellite, flown):
    session_id = sent(api, satellite, flown)
    absent = api.get(f"/sessions/{session_id}/monitoring")
    assert (absent.status_code, absent.json()["code"]) == (404, "not_found")
    found = calibrated(api, [session_id])
    api.post(f"/parameter-sets/{found['id']}/activate", params={"force": True})
    assert api.get(f"/sessions/{session_id}/monitoring").json()["parameter_set_id"] == found["id"]


def test_a_new_calibration_is_held_against_the_set_in_force(api, satellite, flown):
    """DEKART's two sessions: b2 went by -865 nT, found within four standard errors. What came before is left alone."""
    first_id = sent(api, satellite, flown)
    first = calibrated(api, [first_id])
    assert "agreement" not in first
    api.post(f"/parameter-sets/{first['id']}/activate", params={"force": True}).raise_for_status()
    later = calibrated(api, [sent(api, satellite, simulated(SESSIONS[1]).samples)])
    assert later["agreement"]["parameter_set_id"] == first["id"]
    (b2,) = [one for one in later["agreement"]["differences"] if one["parameter"] == "bias_nt[1]"]
    assert b2["difference"] == pytest.approx(-865.0, abs=4 * b2["standard_error"])
    assert [one for one in later["verdict"]["reasons"] if one.startswith("differs_from_active")]
    assert later["verdict"]["grade"] == "weak"
    api.post(f"/parameter-sets/{later['id']}/activate", params={"force": True}).raise_for_status()
    assert "agreement" not in calibrated(api, [first_id], robust="huber")


def test_two_magnetometers_are_compared_after_calibration(api, satellite, flown):
    """The same readings under the same parameters: no rotation and no offset, to rounding."""
    api.post(f"/satellites/{satellite}/magnetometers", json={"id": "second", "unit": "nT"})
    first_id = sent(api, satellite, flown)
    second_id = sent(api, satellite, flown, "second")
    first, second = calibrated(api, [first_id]), calibrated(api, [second_id])
    query = {"other": second_id, "parameter_set": first["id"], "other_parameter_set": second["id"], "distance_m": 0.5}
    found = api.get(f"/sessions/{first_id}/comparison", params=query).json()
    assert found["pairs"] > 100
    assert np.abs(found["rotation_vector_deg"]).max() < 1e-6
    assert np.abs(found["offset_nt"]).max() < 1e-3
    np.testing.assert_allclose(found["gradient_nt_per_m"], np.array(found["offset_nt"]) / 0.5)


def test_a_comparison_needs_two_magnetometers_of_one_satellite(api, satellite, flown):
    session_id = sent(api, satellite, flown)
    answer = api.get(f"/sessions/{session_id}/comparison", params={"other": session_id})
    assert (answer.status_code, answer.json()["code"]) == (422, "option")


def test_a_calibration_of_two_sessions_says_whether_they_agree(api, satellite, flown):
    """The second session has 2000 nT more on axis 2: one bias for each, and the test says that they disagree."""
    ids = [sent(api, satellite, flown), sent(api, satellite, shifted(simulated(SESSIONS[1]).samples, [0, 2000.0, 0]))]
    joint = calibrated(api, ids)["joint"]
    assert {one["label"] for one in joint["sessions"]} == set(ids)
    assert joint["shared"] == [f"{group}[{i}]" for group in ("scale", "nonorthogonality_deg") for i in range(3)]
    scales = {tuple(one["parameters"]["scale"]) for one in joint["sessions"]}
    assert len(scales) == 1
    assert joint["consistency"]["is_consistent"] is False
    assert joint["consistency"]["differences"][0]["parameter"] == "bias_nt[1]"
