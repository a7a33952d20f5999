"""Parameter sets over HTTP: read, export, put in force, roll back, apply."""

import csv
import io
import json
import re
import shutil
import subprocess
import time
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from magcal_core.sensor.conventions import CONVENTIONS, convert
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

CSV = {"content-type": "text/csv"}
FLIGHT_CODE = """
#include <math.h>
#include "mgm.h"
int main(void) {
  for (int i = 0; i < 3; i++) {
    double b = 0.0;
    for (int j = 0; j < 3; j++) {
      double drift = MAGCAL_REGRESSORS_TEMPERATURE[j] * MAGCAL_WORKED_REGRESSORS_TEMPERATURE;
      b += MAGCAL_ROTATION[i][j] * MAGCAL_SCALE[j] * (MAGCAL_WORKED_RAW_NT[j] - MAGCAL_BIAS_NT[j] - drift);
    }
    if (fabs(b - MAGCAL_WORKED_CORRECTED_NT[i]) > 1e-7) return 1;
  }
  return 0;
}
"""


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


def exported(api, found: dict, convention: str, form: str) -> str:
    answer = api.get(f"/parameter-sets/{found['id']}/export", params={"convention": convention, "format": form})
    assert answer.status_code == 200
    return answer.text


def of_csv(text: str) -> dict:
    """Return the document that name,value lines describe, numbers as numbers."""
    document: dict = {}
    for name, value in list(csv.reader(io.StringIO(text)))[1:]:
        *path, last = re.split(r"[.\[]", name.replace("]", ""))
        place = document
        for part in path:
            place = place.setdefault(part, {})
        try:
            place[last] = float(value)
        except ValueError:
            place[last] = value
    return listed(document)


def listed(value: object) -> object:
    """Return dictionaries that count from 0 as lists."""
    if not isinstance(value, dict):
        return value
    inner = {key: listed(one) for key, one in value.items()}
    return list(inner.values()) if inner and list(inner) == [str(i) for i in range(len(inner))] else inner


def of_c(text: str) -> dict:
    """Return the constants of a header, lower case, braces as brackets."""
    constants = re.findall(r"static const double MAGCAL_(\w+?)(?:\[\d\])* = (.*);", text)
    values = {name.lower(): json.loads(value.replace("{", "[").replace("}", "]")) for name, value in constants}
    worked = {name.removeprefix("worked_"): value for name, value in values.items() if name.startswith("worked_")}
    return {"parameters": values, "correction_matrix": values["correction_matrix"], "worked_example": worked}


PARSERS = {"json": json.loads, "yaml": yaml.safe_load, "csv": of_csv, "c": of_c}


def corrected_by(convention: str, document: dict, x: np.ndarray) -> tuple[np.ndarray | None, float]:
    """Return what the file's own formula makes of raw - offset: the vector where it gives one, and the magnitude."""
    p = {name: np.array(value) for name, value in document["parameters"].items() if name != "regressors"}
    if convention == "exact":
        (e1, e2, e3), k = np.deg2rad(p["nonorthogonality_deg"]), p["scale"]
        sin, cos = np.sin, np.cos
        rows = [[1, 0, 0], [sin(e1), cos(e1), 0], [sin(e2), cos(e2) * sin(e3), cos(e2) * cos(e3)]]
        vector = np.linalg.solve(np.diag(k) @ rows, x)
    elif convention == "symmetric":
        vector = p["rotation"] @ np.linalg.solve(p["matrix"], x)
    elif convention == "lower-triangular":
        vector = np.linalg.solve(p["matrix"], x)
    elif convention == "on-board":
        vector = p["rotation"] @ (p["scale"] * x)
    elif convention == "a-matrix":
        return None, float(np.sqrt(x @ p["matrix"] @ x))
    else:
        (e1, e2, e3), d = np.deg2rad(p["nonorthogonality_deg"]), np.diag(1 / p["scale"])
        return None, float(np.sqrt(x @ d @ [[1, -e1, -e2], [-e1, 1, -e3], [-e2, -e3, 1]] @ d @ x))
    return vector, float(np.linalg.norm(vector))


@pytest.fixture(scope="module")
def warmed(service) -> dict:
    """A parameter set with a regressor; the bias of its sensor follows a temperature."""
    with service.client() as api:
        api.post("/satellites", json={"id": "warmed"})
        api.post("/satellites/warmed/magnetometers", json={"id": "mgm", "unit": "nT"})
        api.post("/satellites/warmed/orbits", content=tle_text(), headers={"content-type": "text/plain"})
        clean = simulated(SESSIONS[0]).samples
        temperature = 20 + 15 * np.sin(np.arange(len(clean)) / 60)
        warm = replace(
            clean,
            h_nt=clean.h_nt + temperature[:, None] * [30.0, -20.0, 10.0],
            housekeeping={"temperature": temperature},
        )
        path = "/satellites/warmed/sessions?magnetometer=mgm"
        session = api.post(path, content=write_samples(warm, "csv"), headers=CSV).json()
        return calibrated(api, session["id"], regressors=["temperature"])


@pytest.mark.parametrize("form", PARSERS)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_every_format_and_convention_goes_back_to_the_same_parameters(api, warmed, convention, form):
    """To 1e-12, as printed: a double written by repr is itself again."""
    document = PARSERS[form](exported(api, warmed, convention, form))
    back = convert(document["parameters"], convention, "exact")
    for name in ("bias_nt", "scale", "nonorthogonality_deg"):
        np.testing.assert_allclose(back[name], warmed["parameters"][name], rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(document["correction_matrix"], warmed["correction_matrix"])


@pytest.mark.parametrize("form", PARSERS)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_worked_number_of_a_file_follows_from_its_formula(api, warmed, convention, form):
    """1e-7 nT of 42,000 nT: what a dozen operations on doubles leave; the formula is evaluated here, not by magcal."""
    document = PARSERS[form](exported(api, warmed, convention, form))
    example, parameters = document["worked_example"], document["parameters"]
    drift = np.array(parameters.get("regressors_temperature") or parameters["regressors"]["temperature"])
    column = example.get("regressors_temperature") or example["regressors"]["temperature"]
    x = np.array(example["raw_nt"]) - parameters["bias_nt"] - column * drift
    vector, magnitude = corrected_by(convention, document, x)
    assert magnitude == pytest.approx(example["magnitude_nt"], abs=1e-7)
    by_matrix = np.array(document["correction_matrix"]) @ x
    for one in (by_matrix,) if vector is None else (by_matrix, vector):
        np.testing.assert_allclose(one, example["corrected_nt"], atol=1e-7)


@pytest.mark.parametrize("form", ["json", "yaml", "csv", "c"])
def test_every_file_says_its_formula(api, warmed, form):
    text = " ".join(exported(api, warmed, "on-board", form).replace(" *  ", " ").split())
    assert "corrected = rotation * diag(scale) * (raw - offset)" in text
    assert "offset = bias_nt + regressors.temperature * column temperature" in text


def test_the_c_header_compiles_and_corrects(api, warmed, tmp_path):
    """Flight software's own loop over the header's constants gives the header's worked number."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    assert compiler is not None, "no C compiler is installed; `make system` installs one"
    (tmp_path / "mgm.h").write_text(exported(api, warmed, "on-board", "c"))
    (tmp_path / "main.c").write_text(FLIGHT_CODE)
    command = [compiler, "-Wall", "-Wextra", "-Werror", "-Wno-unused-const-variable", "main.c", "-o", "main", "-lm"]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 0
    assert subprocess.run([tmp_path / "main"], check=False).returncode == 0


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


def test_an_on_board_correction_is_taken_back_before_a_new_fit(api, satellite, found, telemetry):
    """What a satellite corrected with an old set, un-applied by the service, is fitted as the raw readings are."""
    path = f"/parameter-sets/{found['id']}/apply"
    corrected = api.post(path, content=telemetry, headers=CSV).content
    raw = api.post(path, params={"inverse": "true"}, content=corrected, headers=CSV).content
    api.post(f"/satellites/{satellite}/magnetometers", json={"id": "again", "unit": "nT"}).raise_for_status()
    sessions = f"/satellites/{satellite}/sessions?magnetometer=again"
    fits = [calibrated(api, api.post(sessions, content=one, headers=CSV).json()["id"]) for one in (raw, corrected)]
    for name in ("bias_nt", "scale", "nonorthogonality_deg"):
        np.testing.assert_allclose(fits[0]["parameters"][name], found["parameters"][name], rtol=1e-5, err_msg=name)
    assert np.abs(fits[1]["parameters"]["bias_nt"]).max() < 100.0


def test_parameter_sets_of_another_satellite_are_not_there(service, api, found):
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        nothing = bound.get("/parameter-sets/" + "0" * 32)
        assert nothing.status_code == 404
        for path in ("", "/residuals", "/export"):
            assert bound.get(f"/parameter-sets/{found['id']}{path}").content == nothing.content
        for path in ("/activate", "/rollback", "/apply"):
            assert bound.post(f"/parameter-sets/{found['id']}{path}").content == nothing.content
        assert bound.get("/parameter-sets").json()["items"] == []
