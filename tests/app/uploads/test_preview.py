"""A look at telemetry before it is sent says what would be read, finds columns, unit and times, and keeps nothing."""

from __future__ import annotations

import gzip
import json

import httpx2
import numpy as np
import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

CSV = {"content-type": "text/csv"}
FORMS = {"csv": "text/csv", "ndjson": "application/x-ndjson", "json": "application/json",
         "parquet": "application/vnd.apache.parquet"}  # fmt: skip


@pytest.fixture(scope="module")
def flown() -> object:
    return simulated(SESSIONS[0], 60).samples


def looked(api: httpx2.Client, satellite: str, content: bytes, kind: str = "text/csv", **query: object) -> dict:
    path = f"/satellites/{satellite}/sessions/preview"
    asked = {"magnetometer": "mgm", **query}
    return api.post(path, params=asked, content=content, headers={"content-type": kind}).raise_for_status().json()


def foreign(samples: object, *, header: str, form: str, per_nt: float) -> bytes:
    """A table as another station writes it: its own names, unit and form of times, a temperature beside."""
    rows = [header]
    for t_utc, h_nt in zip(samples.t_utc.astype("datetime64[s]").tolist(), samples.h_nt * per_nt, strict=True):
        rows.append(";".join([t_utc.strftime(form), *(f"{value:.6f}" for value in h_nt), "21.5"]))
    return ("\r\n".join(rows) + "\r\n").encode()


def test_what_is_suggested_reads_the_table_and_nothing_is_kept(api, satellite, flown):
    """Names, times and unit are those of no standard; each look mends what the one before named."""
    content = foreign(
        flown, header="Epoch UTC;MAG_X [uT];MAG_Y [uT];MAG_Z [uT];T", form="%d.%m.%Y %H:%M:%S", per_nt=1e-3
    )
    first = looked(api, satellite, content)
    assert first["read"] is None and first["problem"]["code"] == "telemetry_format"
    assert [column["name"] for column in first["columns"]] == [
        "Epoch UTC",
        "MAG_X [uT]",
        "MAG_Y [uT]",
        "MAG_Z [uT]",
        "T",
    ]
    assert [column["may_be"] for column in first["columns"]] == ["time", "bx", "by", "bz", None]
    assert len(first["rows"]) == 5 and first["rows"][0]["cells"][4] == "21.5"
    assert first["suggested_time_formats"][0] == "%d.%m.%Y %H:%M:%S"

    named = {"columns": json.dumps(first["suggested_columns"]), "time_format": first["suggested_time_formats"][0]}
    second = looked(api, satellite, content, **named)
    assert second["missing"] == [] and second["problem"]["code"] == "units_mismatch"
    assert second["suggested_unit"] == "uT"

    third = looked(api, satellite, content, **named, unit="uT")
    assert third["problem"] is None
    assert third["read"]["samples"] == len(flown) and third["read"]["housekeeping"] == ["T"]
    np.testing.assert_allclose(third["read"]["first_nt"], flown.h_nt[:5], atol=1e-3)  # written to 1e-6 uT
    assert third["read"]["first_times"][0][:19] == str(flown.t_utc[0])[:19]
    assert api.get("/sessions", params={"satellite": satellite}).json()["items"] == []

    change = {"columns": first["suggested_columns"], "time_format": named["time_format"], "unit": "uT"}
    api.patch(f"/satellites/{satellite}/magnetometers/mgm", json=change).raise_for_status()
    sent = api.post(f"/satellites/{satellite}/sessions?magnetometer=mgm", content=content, headers=CSV)
    kept = sent.raise_for_status().json()
    assert (kept["samples"], kept["data_from"]) == (third["read"]["samples"], third["read"]["data_from"])


@pytest.mark.parametrize(("form", "kind"), FORMS.items(), ids=FORMS)
def test_every_format_shows_its_first_rows_and_what_it_would_be(api, satellite, flown, form, kind):
    told = looked(api, satellite, write_samples(flown, form), kind)
    assert told["format"] == form and told["problem"] is None
    taken = {column["name"]: column["taken_for"] for column in told["columns"]}
    assert {name: taken[name] for name in ("time", "bx", "by", "bz")} == {
        name: name for name in ("time", "bx", "by", "bz")
    }
    assert told["read"]["samples"] == len(flown) and told["suggested_time_formats"] == []
    row = dict(zip([column["name"] for column in told["columns"]], told["rows"][0]["cells"], strict=True))
    assert float(row["bx"]) == flown.h_nt[0, 0]
    assert told["read"]["b_median_nt"] == pytest.approx(np.median(np.linalg.norm(flown.h_nt, axis=1)))


def test_the_orbit_tells_which_seconds_the_times_are(api, satellite, flown):
    """GPS seconds of 2022 are a plausible date of 2012 too: the epoch of the satellite's TLE decides."""
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    gps_s = (flown.t_utc - np.datetime64("1980-01-06", "ns")).astype(np.int64) / 1e9 + 18.0  # 18 leap seconds by 2017
    rows = [f"{t:.0f},{x:.1f},{y:.1f},{z:.1f}" for t, (x, y, z) in zip(gps_s, flown.h_nt, strict=True)]
    content = gzip.compress(("\n".join(["time,bx,by,bz", *rows]) + "\n").encode())
    told = looked(api, satellite, content)
    assert told["suggested_time_formats"] == ["gps"]
    mended = looked(api, satellite, content, time_format="gps")
    assert mended["read"]["first_times"][0][:19] == str(flown.t_utc[0].astype("datetime64[s]"))


@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02", b"just words\n", "time,bx\r\n".encode("utf-16")])
def test_what_is_no_table_is_told_not_failed(api, satellite, content):
    told = looked(api, satellite, content)
    assert told["read"] is None and told["problem"]["status"] == 422


def test_who_may_not_send_may_not_look(service, api, satellite):
    path = f"/satellites/{satellite}/sessions/preview"
    with service.client(service.key("read")) as reader:
        assert reader.post(path, params={"magnetometer": "mgm"}, content=b"", headers=CSV).status_code == 403
    with service.client(service.key("ingest", satellites=["another"])) as stranger:
        assert stranger.post(path, params={"magnetometer": "mgm"}, content=b"", headers=CSV).status_code == 404
    assert api.post(path, params={"magnetometer": "none"}, content=b"", headers=CSV).status_code == 404
    for bad in ({"columns": "{"}, {"columns": "[1]"}, {"unit": "furlong"}, {"time_epoch": "x"}):
        asked = {"magnetometer": "mgm", **bad}
        assert api.post(path, params=asked, content=b"", headers=CSV).status_code == 422, bad
