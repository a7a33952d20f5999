"""A job that has ended can be asked for again, of every kind, and means the same: what its worker is given is equal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from app.jobs.kinds.contract import Claim
from app.jobs.kinds.registry import JOB_KINDS
from app.jobs.tables import Job
from app.parameter_sets.tables import ParameterSet
from app.records.calibration_options import as_options
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import new_id, utc_now
from magcal_core.options import CalibrationOptions
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

STATE = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "J2000",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}
"""DEKART, 19 February 2022."""
RAW = {"bias_nt": [2000.0, -1500.0, 900.0], "scale": [1.02, 0.99, 1.01], "nonorthogonality_deg": [0.5, -0.3, 0.2]}
ONE_TLE = "".join(tle_text().splitlines(keepends=True)[:3])
CSV, TEXT = {"content-type": "text/csv"}, {"content-type": "text/plain"}
COEFFICIENTS = Path(__file__).resolve().parents[2] / "data" / "field" / "core.shc"


@pytest.fixture(scope="module")
def waiting(tmp_path_factory, serving) -> Iterator:
    """A service whose jobs wait: nobody works on them."""
    yield from serving(Settings(data_dir=tmp_path_factory.mktemp("retry"), workers=0, min_free_mb=0))


class Place:
    """A satellite with a session, an orbit and a parameter set."""

    def __init__(self, service, api: httpx2.Client) -> None:
        self.service, self.api = service, api
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        sent = api.post("/satellites/a/orbits", content=tle_text(), headers=TEXT).json()["items"]
        self.orbits = [one["id"] for one in sent]
        content = write_samples(simulated(SESSIONS[0]).samples, "csv")
        made = api.post("/satellites/a/sessions", params={"magnetometer": "mgm"}, content=content, headers=CSV)
        self.session = made.raise_for_status().json()["id"]
        file = api.post("/field-files", content=COEFFICIENTS.read_bytes(), headers={"content-type": "text/plain"})
        self.field_file = file.raise_for_status().json()["id"]
        self.parameter_set = self._new_set()

    def _new_set(self) -> str:
        with self.service.database.write() as session:
            job = Job(
                id=new_id(), kind="calibration", state="succeeded", priority=0, satellite_id="a",
                magnetometer_id="mgm", request={}, progress=1.0, attempts=1, lost_attempts=0,
                cancel_requested=False, created_at=utc_now(), result={},
            )  # fmt: skip
            session.add(job)
            session.flush()
            row = ParameterSet(
                id=new_id(), satellite_id="a", magnetometer_id="mgm", job_id=job.id, status="candidate",
                grade="accept", method="scalar", data_from=utc_now(), data_until=utc_now(),
                record={"parameters": RAW}, residuals_sha256="0" * 64, created_at=utc_now(),
            )  # fmt: skip
            session.add(row)
            return row.id

    def asked(self, what: str) -> dict[str, object]:
        calibration = {"kind": "calibration", "session_ids": [self.session]}
        return {
            "calibration": calibration | {"priority": 7},
            "calibration with a gyro": calibration | {"gyro": {"columns": ["gx", "gy", "gz"], "unit": "deg/s"}},
            "calibration with candidate orbits": calibration | {"candidate_orbits": self.orbits, "robust": "huber"},
            "calibration with regressors": calibration | {"method": "vector", "regressors": ["time"]},
            "calibration with a field file": calibration | {"field": "file", "field_file": self.field_file},
            "monitoring": {"kind": "monitoring", "session_ids": [self.session]},
            "energy balance by id": {"kind": "energy-balance", "orbit": self.orbits[0], "duration_s": 3000},
            "energy balance by satellite": {"kind": "energy-balance", "satellite": "a", "degree": 8},
            "energy balance by TLE": {"kind": "energy-balance", "tle": ONE_TLE, "duration_s": 3000},
            "energy balance by state": {"kind": "energy-balance", "state": STATE, "propagator": "numerical"},
            "attitude by orbit": {"kind": "attitude-simulation", "satellite": "a", "seed": 3},
            "attitude by parameters": {"kind": "attitude-simulation", "sensor": RAW, "use_proposed_gains": True},
            "attitude by set": {"kind": "attitude-simulation", "sensor": self.parameter_set, "duration": 4000},
        }[what]

    def work(self, job_id: str) -> object:
        """Return what a worker would be given of a job."""
        with self.service.database.read() as session:
            row = session.get_one(Job, job_id)
            claim = Claim(row.id, 1, row.kind, 0, row.satellite_id, row.magnetometer_id, row.request)
            return JOB_KINDS[row.kind].load(session, self.service.services.store, claim)


WHAT = (
    "calibration", "calibration with a gyro", "calibration with candidate orbits", "calibration with regressors",
    "calibration with a field file", "monitoring", "energy balance by id", "energy balance by satellite",
    "energy balance by TLE",
    "energy balance by state", "attitude by orbit", "attitude by parameters", "attitude by set",
)  # fmt: skip


@pytest.fixture(scope="module")
def place(waiting) -> Iterator[Place]:
    with waiting.client() as api:
        yield Place(waiting, api)


def ended(place: Place, body: dict[str, object]) -> dict:
    """Return a job that was asked for and has ended."""
    made = place.api.post("/jobs", json=body)
    assert made.status_code == 202, made.text
    return place.api.post(f"/jobs/{made.json()['id']}/cancel").raise_for_status().json()


SAME = ("kind", "priority", "satellite", "magnetometer", "session_ids", "options", "parent_id")


@pytest.mark.parametrize("what", WHAT)
def test_a_job_of_every_kind_is_asked_again_and_means_the_same(place, what):
    first = ended(place, place.asked(what))
    again = place.api.post(f"/jobs/{first['id']}/retry")
    assert again.status_code == 202, again.text
    second = again.json()
    assert again.headers["location"] == f"/api/v1/jobs/{second['id']}"
    assert second["id"] != first["id"]
    assert second["state"] == "queued"
    assert {name: second[name] for name in SAME} == {name: first[name] for name in SAME}
    assert place.work(second["id"]) == place.work(first["id"])
    with place.service.database.read() as session:
        rows = [session.get_one(Job, one["id"]) for one in (first, second)]
        assert rows[0].lock == rows[1].lock


def test_every_kind_is_among_them(place):
    assert {place.asked(what)["kind"] for what in WHAT} == set(JOB_KINDS)


@pytest.mark.parametrize("what", [one for one in WHAT if one.startswith("calibration")])
def test_the_options_of_a_calibration_are_a_request_for_it(place, what):
    first = ended(place, place.asked(what))
    body = {**first["options"], **{name: first[name] for name in ("kind", "priority", "session_ids")}}
    second = ended(place, body)
    assert second["options"] == first["options"]
    assert place.work(second["id"]) == place.work(first["id"])


def test_a_reprocessing_is_asked_again_with_every_calibration(place):
    asked = place.api.post("/reprocessings", json={"satellites": ["a"], "robust": "huber"})
    first = place.api.post(f"/jobs/{asked.json()['id']}/cancel").raise_for_status().json()
    second = place.api.post(f"/jobs/{first['id']}/retry").raise_for_status().json()
    assert (second["kind"], second["state"], second["options"]) == ("reprocessing", "running", first["options"])
    ask = {"parent": second["id"]}
    (child,) = place.api.get("/jobs", params=ask).json()["items"]
    (before,) = place.api.get("/jobs", params={"parent": first["id"]}).json()["items"]
    assert {name: child[name] for name in SAME[:-1]} == {name: before[name] for name in SAME[:-1]}
    assert place.work(child["id"]) == place.work(before["id"])
    place.api.post(f"/jobs/{second['id']}/cancel").raise_for_status()
    alone = place.api.post(f"/jobs/{before['id']}/retry").raise_for_status().json()
    assert alone["parent_id"] is None, "a calibration that is asked again by itself is a job of its own"
    assert place.work(alone["id"]) == place.work(before["id"])


def test_only_what_has_ended_is_asked_again(place):
    made = place.api.post("/jobs", json=place.asked("energy balance by TLE")).json()
    refused = place.api.post(f"/jobs/{made['id']}/retry")
    assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
    place.api.post(f"/jobs/{made['id']}/cancel").raise_for_status()
    assert place.api.post(f"/jobs/{new_id()}/retry").status_code == 404


def test_one_key_asks_once(place):
    first = ended(place, place.asked("energy balance by TLE"))
    other = ended(place, place.asked("energy balance by TLE"))
    headers = {"Idempotency-Key": "again"}
    made = [place.api.post(f"/jobs/{first['id']}/retry", headers=headers) for _ in range(2)]
    assert [one.status_code for one in made] == [202, 202]
    assert made[0].json()["id"] == made[1].json()["id"]
    refused = place.api.post(f"/jobs/{other['id']}/retry", headers=headers)
    assert (refused.status_code, refused.json()["code"]) == (422, "idempotency_mismatch")


def test_telemetry_that_is_gone_is_said_before_the_job_fails(place):
    first = ended(place, place.asked("calibration"))
    with place.service.database.write() as session:
        session.get_one(TelemetrySession, place.session).raw_removed_at = utc_now()
    refused = place.api.post(f"/jobs/{first['id']}/retry")
    with place.service.database.write() as session:
        session.get_one(TelemetrySession, place.session).raw_removed_at = None
    assert (refused.status_code, refused.json()["code"]) == (410, "expired")


def test_a_request_that_an_earlier_release_queued_keeps_its_gyro():
    old = CalibrationOptions.from_dict({"gyro": ["gx", "gy", "gz"], "gyro_unit": "deg/s"}).to_dict()
    read = CalibrationOptions.from_dict(as_options(old))
    assert (list(read.gyro), read.gyro_unit) == (["gx", "gy", "gz"], "deg/s")
