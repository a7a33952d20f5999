"""What was read back from a flight computer against what was exported, over HTTP and form by form."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime

import httpx2
import numpy as np
import pytest
import yaml

from app.aboard.repository import not_aboard
from app.jobs.tables import Job
from app.parameter_sets.fprime_file import parameter_file, records_of
from app.parameter_sets.tables import ParameterSet
from app.storage.database import new_id, utc_now
from magcal_core.sensor.model import SensorModel

BIAS = [1234.5678901234, -2345.678901234, 345.67890123]
SCALE = [1.0123456789012, 0.98765432109876, 1.00321098765432]
ANGLES = [0.51234567890123, -0.31234567890123, 0.21234567890123]
FORMS = ["json", "csv", "yaml", "c", "gomspace", "fprime"]
CONVENTIONS = ["exact", "on-board", "lower-triangular", "symmetric", "a-matrix", "first-order"]


def record_of(bias_nt: list[float], scale: list[float], angles_deg: list[float]) -> dict:
    sensor = SensorModel(np.array(bias_nt), np.array(scale), np.array(angles_deg))
    errors = {"bias_nt": [1.0] * 3, "scale": [1e-4] * 3, "nonorthogonality_deg": [0.01] * 3}
    shape = {"time_offset_s": None, "regressors": {"temperature": [1.25, -0.5, 0.125]}}
    parameters = {"bias_nt": bias_nt, "scale": scale, "nonorthogonality_deg": angles_deg}
    return {
        "verdict": {"grade": "accept", "reasons": []}, "method": "scalar", "field_model": "igrf-14",
        "orbit_model": "sgp4", "data_from": "2026-01-01T00:00:00Z", "data_until": "2026-01-01T01:00:00Z",
        "parameters": parameters | shape, "standard_errors": errors | shape, "formal_standard_errors": errors | shape,
        "parameter_names": [], "covariance": [], "matrix": sensor.matrix.tolist(), "statistics": {},
        "correction_matrix": sensor.correction_matrix.tolist(), "candidates": [], "observability": {},
        "warnings": [], "provenance": {},
    }  # fmt: skip


def add_set(service, satellite: str, record: dict, status: str = "candidate") -> str:
    job = Job(id=new_id(), kind="calibration", state="succeeded", priority=0, satellite_id=satellite,
              magnetometer_id="mgm", request={}, progress=1.0, attempts=1, lost_attempts=0, cancel_requested=False,
              created_at=utc_now())  # fmt: skip
    row = ParameterSet(id=new_id(), satellite_id=satellite, magnetometer_id="mgm", job_id=job.id, status=status,
                       grade="accept", method="scalar", data_from=datetime(2026, 1, 1, tzinfo=UTC),
                       data_until=datetime(2026, 1, 1, 1, tzinfo=UTC), record=record, residuals_sha256="0" * 64,
                       created_at=utc_now())  # fmt: skip
    with service.database.write() as session:
        session.add(job)
        session.flush()
        session.add(row)
    return row.id


@pytest.fixture
def sets(service, satellite) -> Iterator[tuple[str, str]]:
    """The set in force and the one from before, which has another bias and scale."""
    older = add_set(service, satellite, record_of([1200.0, -2300.0, 300.0], [1.01, 0.99, 1.0], ANGLES), "retired")
    yield add_set(service, satellite, record_of(BIAS, SCALE, ANGLES), "active"), older


def export(api: httpx2.Client, set_id: str, form: str, convention: str = "exact") -> str:
    answer = api.get(f"/parameter-sets/{set_id}/export", params={"format": form, "convention": convention})
    assert answer.status_code == 200, answer.text
    return answer.text


def report(api: httpx2.Client, set_id: str, form: str, content: str, **more: object) -> dict:
    answer = api.post(f"/parameter-sets/{set_id}/aboard", json={"format": form, "content": content, **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def as_singles(content: str) -> str:
    """Return a text with each number of many digits as a flight computer keeps and prints it: %.9g of a float."""
    return re.sub(r"(?<![\w.])-?\d+\.\d{4,}(?:e-?\d+)?", lambda one: f"{np.float32(float(one[0])):.9g}", content)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("form", FORMS)
def test_what_comes_back_as_it_went_up_is_confirmed_and_singles_are_rounded(api, sets, form, convention):
    """Every form in every convention; float32 keeps 24 bits: 45,000 nT come back to 3 mnT, a few times."""
    content = export(api, sets[0], form, convention)
    assert report(api, sets[0], form, content)["state"] == "confirmed"
    found = report(api, sets[0], form, as_singles(content))
    if form in {"gomspace", "fprime"}:
        assert (found["state"], found["differences"]) == ("confirmed", [])
        return
    assert found["state"] == "rounded"
    assert 0.0 < found["effect_nt"] < 0.05
    assert found["matches_parameter_set_id"] is None
    exported = {one["name"]: one for one in found["differences"]}
    assert all(one["aboard"] == float(np.float32(one["exported"])) or
               abs(one["aboard"] / one["exported"] - 1.0) < 6e-8 for one in exported.values())  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_an_older_set_is_recognised_by_name(api, sets, form):
    current, older = sets
    found = report(api, current, form, export(api, older, form, "on-board"))
    assert (found["state"], found["matches_parameter_set_id"]) == ("different", older)
    assert (
        report(api, current, form, as_singles(export(api, older, form, "on-board")))["matches_parameter_set_id"]
        == older
    )


def test_one_wrong_number_is_named_with_what_it_costs(api, sets):
    """A bias 90 nT off: the corrected field moves by 90 nT through the correction and turns by 90/45000 rad."""
    document = json.loads(export(api, sets[0], "json", "exact"))
    document["parameters"]["bias_nt"][1] += 90.0
    found = report(api, sets[0], "json", json.dumps(document))
    assert found["state"] == "different"
    assert found["matches_parameter_set_id"] is None
    (one,) = found["differences"]
    assert one["name"] == "parameters.bias_nt[1]"
    column = np.array(document["correction_matrix"])[:, 1]
    assert one["effect_nt"] == pytest.approx(90.0 * np.linalg.norm(column), rel=1e-6)
    assert one["effect_deg"] == pytest.approx(np.rad2deg(90.0 / 45_000), rel=0.1)


def test_a_rounding_that_costs_too_much_is_another_table(api, sets):
    """Scale factors written with two decimals: 0.99 for 0.98765 is a rounding, and 100 nT."""
    document = yaml.safe_load(export(api, sets[0], "yaml", "exact"))
    document["parameters"]["scale"] = [round(one, 2) for one in SCALE]
    found = report(api, sets[0], "yaml", yaml.safe_dump(document))
    assert found["state"] == "different"
    assert found["effect_nt"] > 50.0
    document["parameters"]["scale"] = [round(one, 6) for one in SCALE]
    assert report(api, sets[0], "yaml", yaml.safe_dump(document))["state"] == "rounded"


def test_a_table_that_is_no_sensors_any_more_has_no_effect_to_tell(api, sets):
    document = json.loads(export(api, sets[0], "json", "lower-triangular"))
    document["parameters"]["matrix"][0] = [0.0, 0.0, 0.0]
    found = report(api, sets[0], "json", json.dumps(document))
    assert (found["state"], found["effect_nt"]) == ("different", None)


def test_a_listing_of_a_gomspace_console_and_a_dump_of_f_prime_are_read(api, sets):
    table = export(api, sets[0], "gomspace")
    numbers: dict[str, list[str]] = {}
    for name, value in re.findall(r"^set (\w+)\[\d+\] (\S+)$", table, re.MULTILINE):
        numbers.setdefault(name, []).append(value)
    assert {name: len(values) for name, values in numbers.items()} == {
        "mgm_offset": 3, "mgm_scale": 3, "mgm_rotation": 9, "mgm_reg_temperature": 3,
    }  # fmt: skip
    listing = "".join(f"0x{16 * n:04X} {name} FLT [{len(values)}]: {' '.join(values)}\n"
                      for n, (name, values) in enumerate(numbers.items()))  # fmt: skip
    assert report(api, sets[0], "gomspace", listing)["state"] == "confirmed"
    document = json.loads(export(api, sets[0], "fprime"))
    renamed = {"Adcs.mag": document["magcal"], "Other.component": {"GAIN": 2.0}}
    assert report(api, sets[0], "fprime", json.dumps(renamed))["state"] == "confirmed"
    offset = [float(one) for one in numbers["mgm_offset"]]
    np.testing.assert_array_equal(np.float32(offset), np.float32(BIAS))


GOLDEN = bytes.fromhex(
    "23b60833a50000001000001a05449a522cc5129add43acd6e6a50000001000001a063fc000003f00000040000000a50000002800001a07"
    "3f8000000000000000000000000000003f8000000000000000000000000000003f800000"
)
"""What `fprime-prm-write` of fprime-gds 4.4.1 makes of `BIAS`, scale (1.5, 0.5, 2) and no rotation, ids from 0x1A05."""


def file_of(api: httpx2.Client, set_id: str, **query: object) -> bytes:
    answer = api.get(f"/parameter-sets/{set_id}/export", params={"format": "fprime-dat", **query})
    assert answer.headers["content-type"] == "application/octet-stream"
    return answer.content


def records(content: bytes) -> list[tuple[int, np.ndarray]]:
    """Return id and numbers of the records of a file without a CRC, by F Prime's documentation (Svc/PrmDb, 3.2)."""
    found = []
    while content:
        assert content[0] == 0xA5
        size = int.from_bytes(content[1:5], "big")
        found.append((int.from_bytes(content[5:9], "big"), np.frombuffer(content[9 : 5 + size], ">f4")))
        content = content[5 + size :]
    return found


def test_a_parameter_file_of_f_prime_is_that_of_its_own_tools():
    numbers = {"mgm_offset": BIAS, "mgm_scale": [1.5, 0.5, 2.0], "mgm_rotation": np.eye(3).ravel().tolist()}
    assert parameter_file(numbers, 0x1A05, has_crc=True) == GOLDEN
    assert parameter_file(numbers, 0x1A05, has_crc=False) == GOLDEN[4:]
    with pytest.raises(ValueError, match="cut"):
        list(records_of(GOLDEN[4:-1]))
    with pytest.raises(ValueError, match="0xA5"):
        list(records_of(GOLDEN[:-1] + b"\1"))


def test_a_parameter_file_goes_up_and_comes_back_with_the_rest_of_the_deployments(api, sets):
    """The flight computer's own file has other parameters, too, and any order; an old one has no CRC; F64 is read."""
    current, older = sets
    plain = file_of(api, current, first_id=0x1A05, crc=False)
    found = records(plain)
    assert [(number, len(values)) for number, values in found] == [(0x1A05, 3), (0x1A06, 3), (0x1A07, 9), (0x1A08, 3)]
    np.testing.assert_array_equal(found[0][1], np.float32(BIAS))
    np.testing.assert_array_equal(found[3][1], np.float32([1.25, -0.5, 0.125]))
    other = bytes([0xA5, 0, 0, 0, 5, 0, 0, 0x10, 0, 7])
    doubles = b"".join(
        bytes([0xA5]) + (4 + 8 * len(v)).to_bytes(4, "big") + n.to_bytes(4, "big") + v.astype(">f8").tobytes()
        for n, v in reversed(found)
    )
    for content in (plain, file_of(api, current, first_id=0x1A05), other + plain + other, doubles):
        answer = report(api, current, "fprime-dat", base64.b64encode(content).decode(), first_id=0x1A05)
        assert (answer["state"], answer["differences"]) == ("confirmed", [])
    content = base64.b64encode(file_of(api, older, first_id=0x1A05)).decode()
    answer = report(api, current, "fprime-dat", content, first_id=0x1A05)
    assert (answer["state"], answer["matches_parameter_set_id"]) == ("different", older)
    assert "mgm_offset[0]" in {one["name"] for one in answer["differences"]}


def test_an_export_of_the_set_in_force_is_noted_once_and_never_steps_back(service, api, satellite, sets):
    current, older = sets

    def told() -> str:
        (line,) = (one["text"] for one in api.get("/attention", params={"satellite": satellite}).json()["items"]
                   if one["code"] == "not_aboard")  # fmt: skip
        return line

    def states(set_id: str) -> list[str]:
        return [one["state"] for one in api.get(f"/parameter-sets/{set_id}/aboard").json()["items"]]

    assert "nobody has reported it aboard" in told()
    for _ in range(3):
        export(api, current, "gomspace")
        export(api, older, "gomspace")
    assert (states(current), states(older)) == (["exported"], [])
    assert "it was exported, not confirmed aboard" in told()
    api.post(f"/parameter-sets/{current}/aboard", json={"state": "uploaded"}).raise_for_status()
    content = export(api, current, "yaml")
    assert states(current) == ["uploaded", "exported"]
    assert "it was uploaded, not confirmed aboard" in told()
    report(api, current, "yaml", content)
    export(api, current, "yaml")
    assert states(current) == ["confirmed", "uploaded", "exported"]


@pytest.mark.parametrize(
    ("form", "content"),
    [
        ("fprime-dat", "no base64!"),
        ("fprime-dat", base64.b64encode(GOLDEN[:-3]).decode()),
        ("fprime-dat", base64.b64encode(GOLDEN).decode()),
        ("json", "{"),
        ("json", "{}"),
        ("json", '{"parameters": {"bias_nt": [1, 2, 3]}}'),
        ("json", '{"parameters": {"bias_nt": [1e999, 2, 3], "scale": [1, 1, 1], "nonorthogonality_deg": [0, 0, 0]}}'),
        ("json", "[" * 5000),
        ("yaml", "a: [b"),
        ("yaml", "a: &a [1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b]\n"
                 "d: &d [*c,*c,*c,*c,*c,*c,*c,*c]\ne: [*d,*d,*d,*d,*d,*d,*d,*d]\n"),
        ("csv", "a,b,c\n"),
        ("c", "int main(void) { return 0; }"),
        ("gomspace", "set other[0] 1\n"),
        ("fprime", '{"magcal": {"MGM_OFFSET": ["x"]}}'),
    ],
)  # fmt: skip
def test_what_is_no_export_is_refused_by_name(api, sets, form, content):
    answer = api.post(f"/parameter-sets/{sets[0]}/aboard", json={"format": form, "content": content})
    assert (answer.status_code, answer.json()["code"]) == (422, "read_back")


def test_a_body_says_one_thing(api, sets):
    for body in ({}, {"format": "json"}, {"content": "x"}, {"state": "confirmed"},
                 {"state": "uploaded", "format": "json", "content": "{}"}):  # fmt: skip
        assert api.post(f"/parameter-sets/{sets[0]}/aboard", json=body).status_code == 422


def test_the_way_into_orbit_is_kept_and_what_is_not_aboard_is_known(service, api, satellite, sets):
    current, older = sets

    def missing() -> list[tuple[str, str | None]]:
        with service.database.read() as session:
            return [(one.parameter_set_id, one.state) for one in not_aboard(session) if one.satellite_id == satellite]

    assert missing() == [(current, None)]
    for state in ("exported", "uploaded"):
        api.post(f"/parameter-sets/{current}/aboard", json={"state": state}).raise_for_status()
        assert missing() == [(current, state)]
    report(api, current, "json", as_singles(export(api, current, "json")))
    assert missing() == []
    report(api, current, "json", export(api, older, "json"))
    assert missing() == [(current, "different")]
    history = api.get(f"/parameter-sets/{current}/aboard").json()["items"]
    assert [one["state"] for one in history] == ["different", "rounded", "uploaded", "exported"]
    assert history[1]["effect_nt"] > 0.0
