"""What a session will be calibrated with is shown before, and is what the parameter set then says of itself."""

from __future__ import annotations

import time
from dataclasses import replace

import httpx2
import numpy as np
import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

PLAIN = {"content-type": "text/plain"}
PATIENCE_S = 120.0


def sent(api: httpx2.Client, satellite: str, samples: object, magnetometer: str = "mgm") -> str:
    path = f"/satellites/{satellite}/sessions?magnetometer={magnetometer}"
    content = write_samples(samples, "csv")
    return api.post(path, content=content, headers={"content-type": "text/csv"}).raise_for_status().json()["id"]


def shown(api: httpx2.Client, session_id: str, **query: object) -> dict:
    return api.get(f"/sessions/{session_id}/preview", params=query).raise_for_status().json()


def calibrated(api: httpx2.Client, session_id: str, **options: object) -> dict:
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id], **options}).json()
    deadline = time.monotonic() + PATIENCE_S
    while (job := api.get(f"/jobs/{job['id']}").json())["state"] in {"queued", "running"}:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert job["state"] == "succeeded", job
    return api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()


@pytest.fixture(scope="module")
def flown() -> object:
    """A session with 40 rows of zeros, and two columns of housekeeping, of which one never changes."""
    samples = simulated(SESSIONS[0], 700).samples
    h_nt = samples.h_nt.copy()
    h_nt[100:140] = 0.0
    keeping = {"temperature": np.linspace(10.0, 20.0, len(samples)), "mode": np.full(len(samples), 3.0)}
    return replace(samples, h_nt=h_nt, housekeeping=keeping)


@pytest.fixture
def orbited(api: httpx2.Client, satellite: str) -> str:
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers=PLAIN).raise_for_status()
    return satellite


def test_the_set_has_what_the_preview_said(api, orbited, flown):
    """Orbit, age, field, method and samples: the same from both, and the zeros are named."""
    session_id = sent(api, orbited, flown)
    said = shown(api, session_id, method="scalar", robust="none", regressors="temperature")
    made = calibrated(api, session_id, method="scalar", robust="none", regressors=["temperature"])
    used = made["provenance"]["orbits"]
    assert [(one["id"], one["samples"]) for one in said["orbits"]] == [(one["id"], one["samples"]) for one in used]
    assert [one["age_days"] for one in said["orbits"]] == pytest.approx([one["age_days"] for one in used])
    assert {one["norad_id"] for one in said["orbits"]} == {"46493"}
    assert (said["field_model"], said["orbit_model"]) == (made["field_model"], made["orbit_model"])
    assert said["options"]["method"] == made["method"]
    assert said["usable"] == made["statistics"]["samples"]
    assert {one["reason"]: one["samples"] for one in said["left_out"]}["zero"] == 40
    assert said["samples"] == len(flown)
    assert {one["name"]: one["is_constant"] for one in said["regressors"]} == {"temperature": False, "mode": True}
    assert (said["options_from"], said["problems"], said["compared_with"]) == ("request", [], None)


def test_the_options_are_those_of_the_request_the_policy_or_the_set_in_force(api, orbited, flown):
    session_id = sent(api, orbited, flown)
    assert shown(api, session_id)["options_from"] == "defaults"
    made = calibrated(api, session_id, method="vector", robust="none")
    api.post(f"/parameter-sets/{made['id']}/activate", json={"force": True, "reason": "a test"}).raise_for_status()
    said = shown(api, session_id)
    assert (said["options_from"], said["options"]["method"]) == ("set_in_force", "vector")
    policy = {"calibrate": False, "method": "scalar", "robust": "tukey"}
    changed = api.patch(f"/satellites/{orbited}/magnetometers/mgm", json={"policy": policy})
    assert changed.status_code == 200, changed.text
    said = shown(api, session_id)
    assert (said["options_from"], said["options"]["robust"]) == ("policy", "tukey")
    assert shown(api, session_id, robust="huber")["options"]["robust"] == "huber"


def test_what_would_make_it_fail_is_said_before_with_the_code_that_the_job_would_have(api, satellite, orbited, flown):
    session_id = sent(api, orbited, replace(flown, t_utc=flown.t_utc + np.timedelta64(300, "D")))
    said = shown(api, session_id)
    assert [one["code"] for one in said["problems"]] == ["tle_epoch"]
    (nearest,) = said["orbits"]
    assert nearest["samples"] == 0
    assert f"{nearest['age_days']:.1f} d" in said["problems"][0]["detail"]
    refused = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id]})
    assert refused.json()["code"] == "tle_epoch"
    assert (said["field_model"], said["samples"]) == (None, len(flown))
    assert shown(api, session_id, max_orbit_age_days=400)["problems"] == []
    assert shown(api, session_id, field="igrf-14+rc", max_orbit_age_days=400)["problems"][0]["code"] != ""
    api.patch(f"/satellites/{orbited}", json={"norad_id": "12345"}).raise_for_status()
    assert "12345" in shown(api, session_id, max_orbit_age_days=400)["orbits"][0]["other_object"]


def test_without_an_orbit_and_without_the_right_to_read(service, api, satellite, flown):
    session_id = sent(api, satellite, flown)
    said = shown(api, session_id)
    assert ([one["code"] for one in said["problems"]], said["orbits"]) == (["orbit_missing"], [])
    with service.client(service.key("ingest")) as sender:
        assert sender.get(f"/sessions/{session_id}/preview").status_code == 403
    with service.client(service.key("read", satellites=["other"])) as bound:
        assert bound.get(f"/sessions/{session_id}/preview").status_code == 404
    with service.client("") as nobody:
        assert nobody.get(f"/sessions/{session_id}/preview").status_code == 401
    assert api.get(f"/sessions/{session_id}/preview", params={"method": "magic"}).status_code == 422
    assert api.get(f"/sessions/{session_id}/preview", params={"regressors": "torque"}).status_code == 200


def test_an_open_session_without_samples_has_nothing_to_show(api, satellite):
    made = api.post(f"/satellites/{satellite}/sessions?magnetometer=mgm&open=true")
    assert made.status_code == 201, made.text
    assert api.get(f"/sessions/{made.json()['id']}/preview").status_code == 409
