"""Parameter sets over HTTP: read, export, put in force, roll back, apply."""

import csv
import io
import shutil
import subprocess
import time

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from app.demo.mission import SESSIONS, simulated, tle_text
from magcal_core.sensor import SensorModel, convert
from magcal_core.telemetry import write_samples

CSV = {"content-type": "text/csv"}


@pytest.fixture(scope="module")
def telemetry() -> bytes:
    return write_samples(simulated(SESSIONS[0]).samples, "csv")


def calibrated(api, session_id, **options) -> dict:
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id], **options}).json()
    while job["state"] in {"queued", "running"}:
        time.sleep(0.02)
        job = api.get(f"/jobs/{job['id']}").json()
    assert job["state"] == "succeeded", job["error"]
    return api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()


@pytest.fixture
def session_id(api, satellite, telemetry) -> str:
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    path = f"/satellites/{satellite}/sessions"
    return api.post(path, params={"magnetometer": "mgm"}, content=telemetry, headers=CSV).json()["id"]


@pytest.fixture
def found(api, session_id) -> dict:
    return calibrated(api, session_id)


def test_a_parameter_set_has_what_the_contract_says(found):
    wanted = {
        *("id", "satellite", "magnetometer", "session_ids", "job_id", "status", "verdict", "created_at", "data_from"),
        *("data_until", "method", "field_model", "orbit_model", "parameters", "standard_errors", "parameter_names"),
        *("covariance", "formal_standard_errors", "matrix", "correction_matrix", "candidates", "statistics"),
        *("observability", "warnings", "provenance"),
    }
    assert wanted <= set(found)
    assert {"software", "inputs", "orbits", "options"} <= set(found["provenance"])
    assert {"id", "epoch", "age_days"} <= set(found["provenance"]["orbits"][0])
    sensor = SensorModel(*(np.array(found["parameters"][n]) for n in ("bias_nt", "scale", "nonorthogonality_deg")))
    np.testing.assert_allclose(found["matrix"], sensor.matrix, rtol=1e-14)


def test_lists_are_cut_by_what_they_are_asked_for(api, satellite, session_id, found):
    other = calibrated(api, session_id, method="vector")

    def listed(**query: str) -> list[str]:
        return [one["id"] for one in api.get("/parameter-sets", params=query).json()["items"]]

    assert listed(satellite=satellite) == [other["id"], found["id"]]
    assert listed(session=session_id, method="vector") == [other["id"]]
    assert listed(satellite=satellite, status="active") == []
    assert listed(satellite=satellite, since="2022-03-01T00:00:00Z") == []
    assert listed(satellite=satellite, until="2022-02-19T00:00:00Z") == []
    assert listed(job=found["job_id"]) == [found["id"]]
    assert api.get("/parameter-sets", params={"order_by": "id; --"}).status_code == 422


def test_residuals_come_as_json_csv_and_parquet(api, found):
    path = f"/parameter-sets/{found['id']}/residuals"
    columns = api.get(path, headers={"accept": "application/json"}).json()
    assert {"time", "corrected_nt", "raw_nt", "model_nt", "residual_nt", "weight"} <= set(columns)
    difference = np.array(columns["corrected_nt"]) - np.array(columns["model_nt"])
    np.testing.assert_allclose(columns["residual_nt"], difference, atol=1e-9)
    assert np.std(columns["residual_nt"]) == pytest.approx(found["statistics"]["after"]["std_nt"], rel=1e-6)
    rows = list(csv.DictReader(io.StringIO(api.get(path, headers={"accept": "text/csv"}).text)))
    assert float(rows[5]["residual_nt"]) == columns["residual_nt"][5]
    table = pq.read_table(io.BytesIO(api.get(path, headers={"accept": "application/vnd.apache.parquet"}).content))
    assert table.num_rows == len(rows) == found["statistics"]["samples"] + found["statistics"]["rejected"]


@pytest.mark.parametrize("convention", ["exact", "first-order", "symmetric", "lower-triangular", "a-matrix"])
def test_every_format_of_an_export_has_the_same_numbers(api, found, convention):
    def exported(form: str) -> str:
        query = {"convention": convention, "format": form}
        answer = api.get(f"/parameter-sets/{found['id']}/export", params=query)
        assert answer.status_code == 200
        return answer.text

    parameters = convert(found["parameters"], "exact", convention)
    assert yaml.safe_load(exported("json"))["parameters"] == parameters
    assert yaml.safe_load(exported("yaml"))["parameters"] == parameters
    rows = dict(csv.reader(io.StringIO(exported("csv"))))
    assert float(rows["parameters.bias_nt[1]"]) == parameters["bias_nt"][1]
    header = exported("c")
    numbers = ", ".join(repr(value) for value in parameters["bias_nt"])
    assert f"static const double MAGCAL_BIAS_NT[3] = {{{numbers}}};" in header


def test_the_c_header_compiles(api, found, tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("there is no C compiler")
    text = api.get(f"/parameter-sets/{found['id']}/export", params={"format": "c"}).text
    (tmp_path / "mgm.h").write_text(text)
    (tmp_path / "main.c").write_text('#include "mgm.h"\nint main(void) { return MAGCAL_SCALE[0] > 2.0; }\n')
    command = [compiler, "-Wall", "-Wno-unused-const-variable", "-c", "main.c"]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 0


def test_an_unknown_convention_is_refused(api, found):
    answer = api.get(f"/parameter-sets/{found['id']}/export", params={"convention": "inverse"})
    assert (answer.status_code, answer.json()["code"]) == (422, "option")


def test_one_parameter_set_is_in_force_and_a_rollback_undoes_it(api, satellite, session_id, found):
    other = calibrated(api, session_id, method="vector")

    def at(time: str) -> list[str]:
        query = {"satellite": satellite, "magnetometer": "mgm", "at": time}
        return [one["id"] for one in api.get("/parameter-sets", params=query).json()["items"]]

    def status(one: dict) -> str:
        return api.get(f"/parameter-sets/{one['id']}").json()["status"]

    first = api.post(f"/parameter-sets/{found['id']}/activate")
    assert (first.status_code, first.json()["status"]) == (200, "active")
    between = api.get("/audit").json()["items"][0]["at"]
    assert api.post(f"/parameter-sets/{other['id']}/activate").json()["status"] == "active"
    assert (status(found), status(other)) == ("retired", "active")
    assert at(between) == [found["id"]]
    assert at("2100-01-01T00:00:00Z") == [other["id"]]
    assert at("2022-02-20T00:00:00Z") == []
    assert api.post(f"/parameter-sets/{found['id']}/rollback").status_code == 409
    assert api.post(f"/parameter-sets/{other['id']}/rollback").json()["status"] == "retired"
    assert (status(found), status(other)) == ("active", "retired")
    assert at("2100-01-01T00:00:00Z") == [found["id"]]
    assert api.post(f"/parameter-sets/{found['id']}/rollback").json()["status"] == "retired"
    assert at("2100-01-01T00:00:00Z") == []


def test_a_refused_verdict_needs_force(service, api, found):
    with service.database.write() as session:
        connection = session.connection()
        connection.exec_driver_sql("UPDATE parameter_set SET grade = 'refuse' WHERE id = ?", (found["id"],))
    refused = api.post(f"/parameter-sets/{found['id']}/activate")
    assert (refused.status_code, refused.json()["code"]) == (409, "verdict_refuse")
    assert api.post(f"/parameter-sets/{found['id']}/activate", json={"force": True}).json()["status"] == "active"


def test_applying_corrects_telemetry_and_the_inverse_brings_it_back(api, found, telemetry):
    path = f"/parameter-sets/{found['id']}/apply"
    corrected = api.post(path, content=telemetry, headers=CSV | {"accept": "application/json"}).json()
    truth = simulated(SESSIONS[0])
    magnitude = np.linalg.norm([corrected["bx"], corrected["by"], corrected["bz"]], axis=0)
    assert np.std(magnitude - np.linalg.norm(truth.b_base_nt, axis=1)) < 150.0  # the noise alone is 100 nT
    as_csv = api.post(path, content=telemetry, headers=CSV)
    assert as_csv.headers["content-type"].startswith("text/csv")
    back = api.post(
        path, params={"inverse": "true"}, content=as_csv.content, headers=CSV | {"accept": "application/json"}
    )
    np.testing.assert_allclose(
        np.column_stack([back.json()[n] for n in ("bx", "by", "bz")]), truth.samples.h_nt, atol=1e-6
    )


def test_parameter_sets_of_another_satellite_are_not_there(service, api, found):
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        nothing = bound.get("/parameter-sets/" + "0" * 32)
        assert nothing.status_code == 404
        for path in ("", "/residuals", "/export"):
            assert bound.get(f"/parameter-sets/{found['id']}{path}").content == nothing.content
        for path in ("/activate", "/rollback", "/apply"):
            assert bound.post(f"/parameter-sets/{found['id']}{path}").content == nothing.content
        assert bound.get("/parameter-sets").json()["items"] == []
