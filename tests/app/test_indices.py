"""Indices and coefficient files over HTTP: kept once, for all satellites, taken by jobs, /field and reprocessings."""

import csv
import json
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import zstandard

from app.access.caller import SYSTEM
from app.indices.repository import IndexRepository
from app.indices.tables import FieldFile
from app.maintenance.audit import audit
from magcal_core.field.index_files import read_index

DATA = Path(__file__).resolve().parents[1] / "data" / "field"
CASES = json.loads((DATA / "cases.json").read_text())
ENDED = {"succeeded", "failed", "cancelled"}


def post(api, path, content, **params):
    return api.post(path, content=content, params=params, headers={"content-type": "application/octet-stream"})


def wait(api, job_id, timeout_s=240.0):
    deadline = time.monotonic() + timeout_s
    while True:
        job = api.get(f"/jobs/{job_id}").json()
        if job["state"] in ENDED:
            return job
        assert time.monotonic() < deadline, job
        time.sleep(0.05)


def record_of(api, job):
    assert job["state"] == "succeeded", job
    return api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()


def vectors(name):
    with (DATA / name).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))[:20]
    places = [[float(row[f"{axis}_km"]) for axis in "xyz"] for row in rows]
    total = [[float(row[f"total_{axis}_nt"]) for axis in "xyz"] for row in rows]
    return [row["time"] for row in rows], places, total


def test_an_index_is_kept_once_and_listed_by_name_and_time(new_service):
    with new_service().client() as api:
        made = post(api, "/indices", (DATA / "rc_2024-05.dat").read_bytes())
        assert made.status_code == 201, made.text
        index = made.json()
        assert (index["name"], index["format"], index["rows"], index["missing"]) == ("RC", "dtu-rc", 168, 0)
        assert (index["first"], index["last"]) == ("2024-05-07T00:00:00.000000Z", "2024-05-14T00:00:00.000000Z")
        again = post(api, "/indices", (DATA / "rc_2024-05.dat").read_bytes())
        assert (again.status_code, again.json()) == (200, index)
        dst = post(api, "/indices", (DATA / "dst_2024-05.txt").read_bytes()).json()
        assert [one["id"] for one in api.get("/indices").json()["items"]] == [dst["id"], index["id"]]
        assert api.get(f"/indices/{index['id']}").json() == index
        for params, want in (
            ({"name": "RC"}, [index["id"]]),
            ({"at": "2024-04-15T00:00:00Z"}, [dst["id"]]),
            ({"name": "Kp"}, []),
            ({"at": "2024-05-14T00:00:00Z"}, []),
        ):
            assert [one["id"] for one in api.get("/indices", params=params).json()["items"]] == want, params
        assert api.get("/indices/" + "0" * 32).status_code == 404


@pytest.mark.parametrize("case", CASES["refusals"] + CASES["file_refusals"], ids=lambda case: case["file"])
def test_bad_files_are_refused_with_their_code(api, case):
    path = "/indices" if case in CASES["refusals"] else "/field-files"
    answer = post(api, path, (DATA / case["file"]).read_bytes())
    assert (answer.status_code, answer.json()["code"]) == (422, case["code"])


def test_only_a_station_that_is_bound_to_no_satellite_sends_them(service, satellite):
    content = b"hour,dst_nt\n2001-05-11T00:00:00Z,-10\n"
    for path in ("/indices", "/field-files"):
        for scopes, satellites, status in (
            (["read"], None, 403),
            (["operate"], None, 403),
            (["ingest"], [satellite], 403),
        ):
            with service.client(service.key(*scopes, satellites=satellites)) as api:
                answer = post(api, path, content)
                assert (answer.status_code, answer.json()["code"]) == (status, "scope_required"), (path, scopes)
        with service.client("") as api:
            assert post(api, path, content).status_code == 401
    with service.client(service.key("ingest")) as api:
        assert post(api, "/indices", content).status_code == 201
        assert api.get("/indices").status_code == 403
    with service.client(service.key("read", satellites=[satellite])) as api:
        assert api.get("/indices").status_code == 200
        assert api.get("/field-files").status_code == 200


def test_the_field_takes_what_is_there(new_service):
    with new_service().client() as api:
        time_utc, places, total = vectors("vectors_rc_storm.csv")
        body = {"time": time_utc, "position_km": places, "model": "igrf-14+rc"}
        missing = api.post("/field", json=body)
        assert (missing.status_code, missing.json()["code"]) == (422, "index_missing")
        post(api, "/indices", (DATA / "rc_2024-05.dat").read_bytes())
        found = api.post("/field", json=body).json()
        assert found["model"] == "igrf-14+rc"
        np.testing.assert_allclose(found["field_nt"], total, rtol=0, atol=1e-6)
        late = body | {"time": ["2026-10-01T12:00:00Z"] * len(places)}
        assert api.post("/field", json=late).json()["code"] == "index_range"
        assert api.post("/field", json=late | {"index_gap": "mean"}).status_code == 200
        time_utc, places, total = vectors("vectors_crust.csv")
        file = post(api, "/field-files", (DATA / "model.cof").read_bytes(), name="WMMHR").json()
        assert (file["name"], file["format"], file["degrees"], file["order"]) == ("WMMHR", "cof", [1, 18], 2)
        body = {"time": time_utc, "position_km": places, "model": "igrf-14+file", "field_file": file["id"]}
        np.testing.assert_allclose(api.post("/field", json=body).json()["field_nt"], total, rtol=0, atol=1e-6)
        assert api.post("/field", json=body | {"field_file": "0" * 32}).status_code == 404
        assert post(api, "/field-files", (DATA / "model.cof").read_bytes()).status_code == 200
        assert [one["id"] for one in api.get("/field-files").json()["items"]] == [file["id"]]
        assert api.get(f"/field-files/{file['id']}").json() == file


def test_jobs_and_reprocessings_take_the_index_that_is_there_when_they_start(new_service):
    with new_service(workers=1).client() as api:
        api.post("/satellites", json={"id": "one"}).raise_for_status()
        api.post("/satellites/one/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        case = CASES["calibrations"][0]
        sent = api.post(
            "/satellites/one/sessions",
            params={"magnetometer": "mgm"},
            content=(DATA / case["file"]).read_bytes(),
            headers={"content-type": "text/csv"},
        )
        session_id = sent.json()["id"]
        ask = {"kind": "calibration", "session_ids": [session_id], "field": "igrf-14+rc"}
        refused = api.post("/jobs", json=ask)
        assert (refused.status_code, refused.json()["code"]) == (422, "index_missing")
        quiet = api.post("/jobs", json={**ask, "field": "igrf", "quiet_only": True})
        assert (quiet.status_code, quiet.json()["code"]) == (422, "index_missing")
        post(api, "/indices", (DATA / "rc_2024-05.dat").read_bytes())
        record = record_of(api, wait(api, api.post("/jobs", json=ask).json()["id"]))
        want = next(run for run in case["runs"] if run["field"] == "igrf-14+rc")
        np.testing.assert_allclose(record["parameters"]["scale"], want["scale"], atol=2e-6)
        assert (record["field_model"], record["external_field"]["kind"]) == ("igrf-14+rc", "rc")
        assert [one["format"] for one in record["provenance"]["indices"]] == ["dtu-rc"]
        plain = record_of(api, wait(api, api.post("/jobs", json={**ask, "field": "igrf-14"}).json()["id"]))
        assert any(reason.startswith("storm") for reason in plain["verdict"]["reasons"])
        monitored = api.get(f"/sessions/{session_id}/monitoring", params={"parameter_set": record["id"]})
        assert monitored.json()["grade"] == "agrees", monitored.text
        residual = api.get(f"/sessions/{session_id}/residual", params={"parameter_set": record["id"]}).json()
        assert residual["rms_nt"] == pytest.approx(want["rms_nt"], rel=0.02)
        # A later version of one hour: the history is made anew with it.
        hour = b"hour,rc_external_nt,rc_induced_nt\n2024-05-11T02:00:00Z,-100,-20\n"
        later = post(api, "/indices", hour).json()
        parent = api.post("/reprocessings", json={"field": "igrf-14+rc"}).json()
        wait(api, parent["id"])
        job = api.get("/jobs", params={"parent": parent["id"]}).json()["items"][0]
        again = record_of(api, job)
        assert sorted(one["format"] for one in again["provenance"]["indices"]) == ["csv", "dtu-rc"]
        assert later["sha256"] in {one["sha256"] for one in again["provenance"]["indices"]}
        assert abs(again["parameters"]["scale"][0] - want["scale"][0]) > 1e-5
        crust = {**ask, "field": "igrf-14+file"}
        assert api.post("/jobs", json=crust).json()["code"] == "option"
        file = post(api, "/field-files", (DATA / "model.cof").read_bytes()).json()
        assert api.post("/jobs", json={**ask, "field_file": file["id"]}).json()["code"] == "option"
        assert api.post("/jobs", json={**crust, "field_file": "0" * 32}).status_code == 404
        refused = wait(api, api.post("/jobs", json={**crust, "field_file": file["id"]}).json()["id"])
        assert refused["error"]["code"] == "model_range"  # the session is of 2024, the model from 2025 on


def test_an_audit_reads_every_file(new_service):
    service = new_service()
    with service.client() as api:
        post(api, "/indices", (DATA / "rc_2024-05.dat").read_bytes())
        file = post(api, "/field-files", (DATA / "core.shc").read_bytes()).json()
    store = service.services.store
    assert audit(service.database, store).findings == ()
    with service.database.write() as session:
        row = session.get_one(FieldFile, file["id"])
        row.content = zstandard.compress(b"another")
    assert [one.subject for one in audit(service.database, store).findings] == [f"field_file/{file['id']}"]


def test_files_whose_hours_came_again_are_not_loaded(new_service):
    service = new_service()
    day = "2024-05-{:02d}T{:02d}:00:00Z,{}"
    with service.database.write() as session:
        repository = IndexRepository(session, SYSTEM)
        for until in (5, 10, 15):
            rows = [day.format(1 + h // 24, h % 24, -until) for h in range(24 * until)]
            content = "\n".join(["hour,dst_nt", *rows]).encode()
            repository.add_index(content, read_index(content))
        holed = b"hour,dst_nt\n2024-05-02T00:00:00Z,\n2024-05-02T01:00:00Z,-99\n"
        repository.add_index(holed, read_index(holed))
        begin = datetime(2024, 5, 3, tzinfo=UTC)
        assert len(repository.intervals_near(begin, begin)) == 2
        series = repository.sources(begin, begin).hourly("Dst")
        assert series.total_nt[25] == -99.0
        assert series.total_nt[24] == -15.0
