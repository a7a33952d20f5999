"""How a magnetometer's telemetry is read: settings that may change, what they change, and what stays."""

import json

import numpy as np
import pytest

from magcal_core.simulation.dekart_mission import tle_text
from magcal_core.telemetry import read_telemetry

N = 30
TIMES = np.datetime64("2022-02-19T22:37:44", "ns") + np.arange(N) * np.timedelta64(10, "s")
H = [*np.round(np.random.default_rng(5).normal(0.0, 20000.0, (N, 3))), 20000.0, 20000.0, 20000.0]


def body(times: object = TIMES, scale: float = 1.0, extra: str = "") -> str:
    rows = (",".join([str(t), *(f"{v / scale:.10g}" for v in h)]) + extra for t, h in zip(times, H, strict=True))
    header = "time,bx,by,bz,ok" if extra else "time,bx,by,bz"
    return "\n".join([header, *rows]) + "\n"


ISO = [f"{np.datetime_as_string(t, unit='ms')}Z" for t in TIMES]
MS = TIMES.astype("datetime64[ms]").astype(np.int64)


def magnetometer(api, satellite: str, **settings: object) -> str:
    name = f"m{abs(hash(json.dumps(settings)))}"
    made = api.post(f"/satellites/{satellite}/magnetometers", json={"id": name, "unit": "nT"} | settings)
    made.raise_for_status()
    assert {key: made.json()[key] for key in settings} == settings
    return name


def send(api, satellite: str, name: str, content: str, **query: object):
    return api.post(
        f"/satellites/{satellite}/sessions", content=content, headers={"content-type": "text/csv"},
        params={"magnetometer": name, **query},
    )  # fmt: skip


def samples(api, session_id: str):
    answer = api.get(f"/sessions/{session_id}/samples", headers={"accept": "text/csv"})
    answer.raise_for_status()
    return read_telemetry(answer.content, format="csv").samples


@pytest.mark.parametrize(
    ("settings", "content"),
    [
        ({"time_format": "unix-ms"}, body(MS)),
        ({"columns": {"time_ms": "time"}, "time_format": "ms"}, body(MS)),
        ({"columns": {"time_unix_ms": "time"}}, body(MS)),
        ({"time_format": "utc"}, body(TIMES)),
        ({"unit": "counts", "nt_per_count": 12.5}, body(ISO, 12.5)),
        ({"fill_values": [-7777.0], "validity_column": "ok", "valid_values": [1]}, body(ISO, extra=",1")),
    ],
)
def test_what_is_said_of_a_magnetometer_reads_its_telemetry(api, satellite, settings, content):
    if "time_ms" in settings.get("columns", {}):
        settings = {"time_format": "ms"}
    sent = send(api, satellite, magnetometer(api, satellite, **settings), content)
    assert sent.status_code == 201, sent.json()
    got = samples(api, sent.json()["id"])
    np.testing.assert_array_equal(got.t_utc, TIMES)
    np.testing.assert_allclose(got.h_nt, H, rtol=1e-9)


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"unit": "counts"}, "units_missing"),
        ({"nt_per_count": 2.0}, "units_mismatch"),
        ({"time_format": "tai64"}, "option"),
        ({"valid_values": [1]}, "option"),
        ({"time_format": "gps", "time_epoch": "2022-01-01T00:00:00Z"}, "option"),
        ({"fill_values": ["x"]}, "invalid"),
    ],
)
def test_what_cannot_be_is_refused_at_once(api, satellite, settings, code):
    made = api.post(f"/satellites/{satellite}/magnetometers", json={"id": "m", "unit": "nT"} | settings)
    assert (made.status_code, made.json()["code"]) == (422, code)
    changed = api.patch(f"/satellites/{satellite}/magnetometers/mgm", json=settings)
    assert (changed.status_code, changed.json()["code"]) == (422, code)
    assert api.get(f"/satellites/{satellite}/magnetometers/mgm").json()["unit"] == "nT"


def test_a_change_counts_for_what_comes_after_it_and_only_for_that(api, satellite):
    """The first session keeps how it was read; read again, it is read as the magnetometer is now."""
    first = send(api, satellite, "mgm", body(ISO))
    settings = {"unit": "uT", "axis_map": ["y", "-x", "z"], "range_nt": 90_000.0, "columns": {"bx": "bx"}}
    changed = api.patch(f"/satellites/{satellite}/magnetometers/mgm", json=settings)
    assert changed.status_code == 200
    assert {key: changed.json()[key] for key in settings} == settings
    second = send(api, satellite, "mgm", body(ISO, 1000.0))
    want = np.column_stack([H[:, 1], -H[:, 0], H[:, 2]])
    np.testing.assert_allclose(samples(api, second.json()["id"]).h_nt, want, rtol=1e-9)
    np.testing.assert_array_equal(samples(api, first.json()["id"]).h_nt, H)
    api.patch(f"/satellites/{satellite}/magnetometers/mgm", json={"unit": "nT"}).raise_for_status()
    again = api.post(f"/sessions/{first.json()['id']}/read-again")
    assert again.status_code == 200
    np.testing.assert_allclose(samples(api, first.json()["id"]).h_nt, want, rtol=1e-9)


def test_counts_may_come_and_go(api, satellite):
    where = f"/satellites/{satellite}/magnetometers/mgm"
    assert api.patch(where, json={"unit": "counts", "nt_per_count": 4.0}).json()["unit"] == "counts"
    assert api.patch(where, json={"noise_nt": 5.0}).json()["nt_per_count"] == 4.0
    back = api.patch(where, json={"unit": "mG"}).json()
    assert (back["unit"], back["nt_per_count"]) == ("mG", None)


def test_seconds_since_boot_have_their_epoch_from_the_upload(api, satellite):
    name = magnetometer(api, satellite, time_format="boot")
    content = body(100 + 10 * np.arange(N))
    refused = send(api, satellite, name, content)
    assert (refused.status_code, refused.json()["code"]) == (422, "option")
    sent = send(api, satellite, name, content, time_epoch="2022-02-19T22:36:04Z")
    assert sent.status_code == 201
    np.testing.assert_array_equal(samples(api, sent.json()["id"]).t_utc, TIMES)
    other = send(api, satellite, name, content, time_epoch="2022-02-20T22:36:04Z")
    assert (other.status_code, other.json()["code"]) == (409, "conflict")
    api.post(f"/sessions/{sent.json()['id']}/read-again").raise_for_status()
    np.testing.assert_array_equal(samples(api, sent.json()["id"]).t_utc, TIMES)


def test_the_forms_near_the_satellites_orbits_are_named(api, satellite):
    api.post(
        f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"}
    ).raise_for_status()
    refused = send(api, satellite, "mgm", body(MS)).json()
    assert refused["code"] == "time"
    assert "milliseconds since 1970? --time-format unix-ms (within three days of the orbit)" in refused["detail"]
    j2000 = (TIMES - np.datetime64("2000-01-01T12:00", "ns")) / np.timedelta64(1, "s")
    session = send(api, satellite, "mgm", body(j2000)).json()
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session["id"]]}).json()
    assert job["code"] == "tle_epoch"
    assert job["detail"].endswith("limit 14 d: J2000 seconds? --time-format j2000")


def test_near_names_of_columns_are_proposed_and_values_are_not_repeated(api, satellite):
    content = body(ISO).replace("time,bx,by,bz", "Time,mag_x [nT],mag_y [nT],mag_z [nT]")
    refused = send(api, satellite, "mgm", content).json()
    wanted = {"time": "Time", "bx": "mag_x [nT]", "by": "mag_y [nT]", "bz": "mag_z [nT]"}
    assert f"the column map {json.dumps(wanted)}" in refused["detail"]
    assert "did you mean 'mag_x [nT]'?" in str(refused["errors"])
    api.patch(f"/satellites/{satellite}/magnetometers/mgm", json={"columns": wanted}).raise_for_status()
    assert send(api, satellite, "mgm", content).status_code == 201
    secret = send(api, satellite, "mgm", content.replace(ISO[3], "19.02.2022 s3cret")).text
    assert "s3cret" not in secret
