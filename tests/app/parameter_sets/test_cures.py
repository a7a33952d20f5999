"""Cures over HTTP: whoever makes the call that a reason or a failure offers gets a better verdict."""

from __future__ import annotations

from dataclasses import replace

import httpx2
import numpy as np
import pytest

from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_of, tle_text
from magcal_core.simulation.telemetry import Disturbances, simulate
from tests.app.attention.test_attention import ended, entries, press
from tests.app.monitoring.test_monitoring import calibrated, sent

GRADES = ("refuse", "weak", "accept")
BAD = slice(280, 455)
"""Rows of a stretch that hold something else: 29 minutes, a quarter of the session."""
PLAIN = {"content-type": "text/plain"}


@pytest.fixture(scope="module")
def flown() -> Samples:
    return simulated(SESSIONS[0]).samples


@pytest.fixture
def orbited(api: httpx2.Client, satellite: str) -> str:
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers=PLAIN).raise_for_status()
    return satellite


def disturbed(flown: Samples) -> Samples:
    """The session with 8 uT of something else on one axis over `BAD`."""
    h_nt = flown.h_nt.copy()
    h_nt[BAD, 0] += 8000.0 * np.sin(np.arange(BAD.stop - BAD.start) / 20.0)
    return replace(flown, h_nt=h_nt)


def late(flown: Samples, seconds: float) -> Samples:
    return replace(flown, t_utc=flown.t_utc + np.timedelta64(round(seconds * 1000), "ms"))


def offers(api: httpx2.Client, record: dict) -> dict[str, dict]:
    """Return label -> the cure of each reason that has one."""
    items = api.get(f"/parameter-sets/{record['id']}/reasons").raise_for_status().json()["items"]
    return {one["cure"]["label"]: one["cure"] for one in items if one["cure"] is not None}


def cured(api: httpx2.Client, cure: dict) -> dict:
    """Return the parameter set of the job that the cure's path and body make."""
    assert cure["method"] == "POST", cure
    job = api.post(cure["path"].removeprefix("/api/v1"), json=cure["body"]).raise_for_status().json()
    after = ended(api, job["id"])
    assert after["state"] == "succeeded", after["error"]
    return api.get(f"/parameter-sets/{after['result']['parameter_set_id']}").json()


def assert_better(after: dict, before: dict) -> None:
    grades = [GRADES.index(one["verdict"]["grade"]) for one in (after, before)]
    assert grades[0] > grades[1], (before["verdict"], after["verdict"])


def state_vector(orbit: Sgp4Orbit, at: np.datetime64, said: np.datetime64) -> dict[str, object]:
    """Return the state at ``at`` as a state vector that says it is of ``said``."""
    r_km, v_km_s = (one[0].tolist() for one in orbit.state_gcrf(np.array([at])))
    return {"epoch": utc(said), "frame": "GCRF", "position_km": r_km, "velocity_km_s": v_km_s}


def day(time: np.datetime64) -> str:
    return f"{time.astype('datetime64[s]').item():%-d %b %Y}"


def utc(time: np.datetime64) -> str:
    return f"{np.datetime_as_string(time, unit='us')}Z"


def test_the_stretch_that_the_loss_rejects_is_left_out_at_a_press(api, orbited, flown) -> None:
    session_id = sent(api, orbited, disturbed(flown))
    before = calibrated(api, [session_id])
    assert any(one.startswith("many_rejected") for one in before["verdict"]["reasons"])
    (stretch,) = before["data_quality"]["rejected_stretches"]
    assert utc(flown.t_utc[BAD.start - 5]) <= stretch["from"] <= utc(flown.t_utc[BAD.start + 10])
    assert utc(flown.t_utc[BAD.stop - 10]) <= stretch["until"] <= utc(flown.t_utc[BAD.stop + 5])
    (cure,) = [one for label, one in offers(api, before).items() if label.startswith("Leave out")]
    begin, end = cure["body"]["without"][0].split("/")
    assert cure["label"] == f"Leave out {begin[11:16]}-{end[11:16]}"
    assert begin <= stretch["from"] and stretch["until"] <= end
    after = cured(api, cure)
    assert_better(after, before)
    assert after["provenance"]["options"]["without"] == [f"{begin}/{end}"]
    assert any(one.startswith("spans_left_out: ") for one in after["warnings"])
    assert not any(label.startswith("Leave out") for label in offers(api, after))
    # As if the rows had not been sent: the same numbers as of a session without them.
    inside = (flown.t_utc >= np.datetime64(begin[:-1])) & (flown.t_utc < np.datetime64(end[:-1]))
    api.post(f"/satellites/{orbited}/magnetometers", json={"id": "cut", "unit": "nT"}).raise_for_status()
    rest = calibrated(api, [sent(api, orbited, disturbed(flown).take(~inside), "cut")])
    assert after["parameters"] == rest["parameters"]
    assert after["standard_errors"] == rest["standard_errors"]


@pytest.mark.parametrize(("scale", "ahead_s"), [("gps", 18.0), ("tai", 37.0), ("tt", 69.184)])
def test_times_of_another_scale_are_taken_as_such_at_a_press(api, orbited, flown, scale, ahead_s) -> None:
    """TAI is 37 s ahead of UTC since 2017, GPS 19 s behind TAI, TT 32.184 s ahead of it."""
    session_id = sent(api, orbited, late(flown, ahead_s))
    plain = {"robust": "none", "noise_model": "none", "time_offset": "none"}
    before = calibrated(api, [session_id], **plain)
    assert before["verdict"]["grade"] == "refuse"
    assert [one["code"] for one in before["suspicions"]] == ["time_scale_suspect"]
    after = cured(api, offers(api, before)[f"As {scale.upper()} time"])
    assert_better(after, before)
    truth = calibrated(api, [sent(api, orbited, flown)], **plain)
    for name, errors in truth["standard_errors"].items():
        if name in {"bias_nt", "scale", "nonorthogonality_deg"}:
            moved = np.subtract(after["parameters"][name], truth["parameters"][name])
            np.testing.assert_array_less(np.abs(moved), 1e-3 * np.asarray(errors))
    assert f"As {scale.upper()} time" not in offers(api, after)


def test_a_calibration_that_failed_for_its_clock_is_made_as_gps_time_at_a_press(api, orbited, flown) -> None:
    session_id = sent(api, orbited, late(flown, 18.0))
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id]}).json()
    assert ended(api, job["id"])["error"]["diagnosis"]["findings"][0]["code"] == "clock"
    told = entries(api, orbited)["job_failed"]
    assert told["action"]["label"] == "As GPS time"
    after = ended(api, press(api, told).json()["id"])
    assert (after["state"], after["verdict"]) == ("succeeded", "accept")
    assert "job_failed" not in entries(api, orbited)


def test_spikes_that_plain_least_squares_takes_for_readings_are_rejected_by_tukey(api, orbited, flown) -> None:
    h_nt = flown.h_nt.copy()
    h_nt[::40, 1] += 9000.0
    before = calibrated(api, [sent(api, orbited, replace(flown, h_nt=h_nt))], robust="none")
    assert before["verdict"]["grade"] == "refuse"
    assert_better(cured(api, offers(api, before)["Again with tukey"]), before)


def test_a_bias_that_follows_a_current_is_taken_up_by_the_regressor_that_unseen_blocks_support(api, orbited, flown):
    current = np.repeat(np.random.default_rng(1).integers(0, 2, len(flown) // 5 + 1), 5)[: len(flown)].astype(float)
    h_nt = flown.h_nt + current[:, None] * np.array([900.0, -600.0, 400.0])
    loaded = replace(flown, h_nt=h_nt, housekeeping={"current_a": current})
    before = calibrated(api, [sent(api, orbited, loaded)], robust="tukey")
    after = cured(api, offers(api, before)["With the regressors that unseen blocks support"])
    assert_better(after, before)
    assert list(after["parameters"]["regressors"]) == ["current_a"]


def test_the_clock_is_looked_for_where_the_orbit_is_old(api, satellite, flown) -> None:
    """The telemetry is four days from the orbit, and nobody looked how far along its track the satellite is."""
    session = SESSIONS[0]
    away = simulate(
        Sgp4Orbit(tle_of(session)), session.sensor, session.start_utc + np.timedelta64(4, "D"), 7000.0, 10.0,
        disturbances=Disturbances(noise_nt=20.0), seed=1,
    )  # fmt: skip
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers=PLAIN).raise_for_status()
    before = calibrated(api, [sent(api, satellite, away.samples)], time_offset="none")
    assert any(one.startswith("orbit_old") for one in before["verdict"]["reasons"])
    assert_better(cured(api, offers(api, before)["Look for the clock"]), before)


def test_an_orbit_that_has_come_since_is_used_at_a_press(api, satellite, flown) -> None:
    """The set was made with an orbit of four days before; then one of the day of the data came."""
    session = SESSIONS[0]
    begin = session.start_utc + np.timedelta64(4, "D")
    orbit = Sgp4Orbit(tle_of(session))
    away = simulate(
        orbit, session.sensor, begin, 7000.0, 10.0, disturbances=Disturbances(noise_nt=20.0), seed=1
    ).samples
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers=PLAIN).raise_for_status()
    session_id = sent(api, satellite, away)
    before = calibrated(api, [session_id], time_offset="none")
    assert any(one.startswith("orbit_old") for one in before["verdict"]["reasons"])
    assert not any(label.startswith("Use the orbit of") for label in offers(api, before))
    api.post(f"/satellites/{satellite}/orbits", json=state_vector(orbit, begin, begin)).raise_for_status()
    assert_better(cured(api, offers(api, before)[f"Use the orbit of {day(begin)}"]), before)


def test_a_calibration_that_failed_for_its_orbit_uses_the_one_that_came(api, satellite, flown) -> None:
    """The first orbit has the satellite 300 s along its track from where it is, and is of two days before."""
    session = SESSIONS[0]
    orbit, begin = Sgp4Orbit(tle_of(session)), session.start_utc
    epoch = begin - np.timedelta64(2, "D")
    wrong = state_vector(orbit, epoch + np.timedelta64(300, "s"), epoch)
    api.post(f"/satellites/{satellite}/orbits", json=wrong).raise_for_status()
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [sent(api, satellite, flown)]}).json()
    failed = ended(api, job["id"])
    assert failed["state"] == "failed"
    assert entries(api, satellite)["job_failed"]["action"]["label"] in {"Choose orbit", "Look for the clock"}
    api.post(f"/satellites/{satellite}/orbits", json=state_vector(orbit, begin, begin)).raise_for_status()
    told = entries(api, satellite)["job_failed"]
    assert told["action"]["label"] == f"Use the orbit of {day(begin)}"
    after = ended(api, press(api, told).json()["id"])
    assert (after["state"], after["verdict"]) == ("succeeded", "accept")
