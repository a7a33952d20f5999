"""Refits over HTTP from stored moments: what a new job with those options would say, and no telemetry for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import httpx2
import numpy as np
import pytest
from sqlalchemy import update

from app.client.asynchronous import AsyncClient
from app.client.blocking import Client
from app.jobs.engines.open_engine import open_engine
from app.maintenance.audit import audit
from app.maintenance.retention import remove_expired
from app.parameter_sets.tables import ParameterSet
from app.storage.database_store import DatabaseStore
from app.storage.open_store import open_store
from app.storage.store import moments_key
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from tests.apart import run_apart
from tests.app.monitoring.test_monitoring import calibrated as calibrated_as_asked
from tests.app.monitoring.test_monitoring import sent

SAME_STEP = 0.1
"""Standard errors by which one Gauss-Newton step may differ from a fit that takes them all and weighs anew."""
SAME_ERROR = 0.05
"""Share by which standard errors may differ where the residual is the same, a little of noise aside."""
OTHER_ERROR = 0.5
"""And where it is another, or blocks are cut elsewhere: they rest on its lowest frequencies, of which there are few."""
DRIFT_NT = np.array([12.0, -8.0, 4.0])
MIDDLE = slice(200, 300)


def warmed() -> Samples:
    """A session whose bias follows its temperature; ``rumble`` moves nothing."""
    clean = simulated(SESSIONS[0]).samples
    temperature = 20.0 + 15.0 * np.sin(np.arange(len(clean)) / 60.0)
    return replace(
        clean,
        h_nt=clean.h_nt + temperature[:, None] * DRIFT_NT,
        housekeeping={"temperature": temperature, "rumble": np.random.default_rng(1).normal(size=len(clean))},
    )


@dataclass(frozen=True)
class Fitted:
    """A client, a session, and its parameter set with the temperature as a regressor."""

    api: httpx2.Client
    satellite: str
    session_id: str
    record: dict

    @property
    def path(self) -> str:
        """Where the refits of the set are."""
        return f"/parameter-sets/{self.record['id']}/refit"

    def refit(self, **query: object) -> dict:
        """Return the refit that ``query`` asks for."""
        answer = self.api.get(self.path, params=query)
        assert answer.status_code == 200, answer.text
        return answer.json()


def calibrated(api: httpx2.Client, session_ids: list[str], **options: object) -> dict:
    """Return a set whose errors know what a refit's can: errors that follow the orbit are in no moments."""
    plain = {"robust": "none", "noise_model": "none", "time_offset": "none", "locked_terms": "none"}
    return calibrated_as_asked(api, session_ids, **(plain | options))


def fit(api: httpx2.Client, satellite: str, **options: object) -> Fitted:
    """Return a new calibration of a new session."""
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    session_id = sent(api, satellite, warmed())
    return Fitted(
        api, satellite, session_id, calibrated(api, [session_id], **({"regressors": ["temperature"]} | options))
    )


@pytest.fixture
def fitted(api, satellite) -> Fitted:
    return fit(api, satellite)


def values(parameters: dict) -> np.ndarray:
    """Return the parameters, or errors of them, in a row, the clock aside."""
    groups = [parameters[name] for name in ("bias_nt", "scale", "nonorthogonality_deg")]
    return np.concatenate([*groups, *(parameters["regressors"][name] for name in sorted(parameters["regressors"]))])


def assert_same(found: dict, job: dict, same_error: float = SAME_ERROR) -> None:
    """Hold a refit against the parameter set of a job, by the errors of the job."""
    errors = values(job["standard_errors"])
    np.testing.assert_array_less(np.abs(values(found["parameters"]) - values(job["parameters"])) / errors, SAME_STEP)
    np.testing.assert_allclose(values(found["standard_errors"]), errors, rtol=same_error)


@contextmanager
def workers_of(service: object) -> Iterator[None]:
    """Let a worker take up jobs; a server on SQLite has its own."""
    workers = None
    if not service.database.is_sqlite:
        workers = open_engine(service.database, open_store(service.settings), service.settings, 1).workers
        workers.start()
    try:
        yield
    finally:
        if workers is not None:
            workers.stop(20.0)


@pytest.mark.parametrize("database", ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def test_a_job_keeps_moments_and_a_refit_from_them_says_what_a_new_job_would(new_service, request, database):
    url = None if database == "sqlite" else request.getfixturevalue("postgres_url")
    service = new_service(workers=1, database_url=url)
    with service.client() as api, workers_of(service):
        api.post("/satellites", json={"id": "warm"}).raise_for_status()
        api.post("/satellites/warm/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        fitted = fit(api, "warm")
        same = fitted.refit()
        assert same["parameter_set_id"] == fitted.record["id"]
        assert_same(same, fitted.record)
        for names in ("", "rumble", "temperature", "temperature,rumble"):
            job = calibrated(api, [fitted.session_id], regressors=names.split(",") if names else [])
            error = SAME_ERROR if "temperature" in names else OTHER_ERROR
            assert_same(fitted.refit(regressors=names), job, error)
        chosen = fitted.refit(regressors="auto")
        anew = calibrated(api, [fitted.session_id], regressors="auto")
        assert [one["regressors"] for one in chosen["ablation"] if one["selected"]] == [["temperature"]]
        assert_same(chosen, anew)


def test_a_vector_fit_is_refitted_as_well(api, satellite):
    fitted = fit(api, satellite, method="vector")
    job = calibrated(api, [fitted.session_id], method="vector", regressors=[])
    assert_same(fitted.refit(regressors=""), job)


def test_a_span_left_out_counts_as_if_it_had_not_been_sent(api, fitted):
    """The cut is to within a block, a sixtieth of the data: a tenth of the block at either end changes little."""
    samples = warmed()
    begin, end = np.datetime_as_string(samples.t_utc[[MIDDLE.start, MIDDLE.stop]], "us")
    found = fitted.refit(without=f"{begin}Z/{end}Z")
    assert found["left_out_share"] == pytest.approx(100 / len(samples), rel=0.02)
    api.post(f"/satellites/{fitted.satellite}/magnetometers", json={"id": "cut", "unit": "nT"}).raise_for_status()
    rest = samples.take(np.delete(np.arange(len(samples)), MIDDLE))
    job = calibrated(api, [sent(api, fitted.satellite, rest, "cut")], regressors=["temperature"])
    assert_same(found, job, OTHER_ERROR)
    middle = np.datetime_as_string(samples.t_utc[250], "us")
    halves = fitted.refit(without=[f"{begin}Z/{middle}Z", f"{middle}Z/{end}Z"])
    np.testing.assert_allclose(values(halves["parameters"]), values(found["parameters"]), rtol=1e-9)


def test_the_clock_is_an_unknown_where_it_is_asked_for(api, fitted):
    job = calibrated(api, [fitted.session_id], regressors=["temperature"], time_offset="estimate")
    found = fitted.refit(time_offset="true")
    assert_same(found, job)
    clock = found["time_offset"]
    # A job adds what the external field does to the clock, which no moments tell.
    honest = job["standard_errors"]["time_offset_s"]
    assert 0.5 * honest < clock["standard_error_s"] < honest * (1.0 + SAME_ERROR)
    assert abs(clock["offset_s"] - job["parameters"]["time_offset_s"]) < SAME_STEP * clock["standard_error_s"]
    assert fitted.refit(time_offset="false")["time_offset"] is None


def test_a_bootstrap_from_moments_has_the_errors_of_a_job_s(api, fitted):
    """The same replicates, drawn with the same seed; and the seed decides."""
    job = calibrated(api, [fitted.session_id], regressors=["temperature"], bootstrap=200, seed=3)["bootstrap"]
    found = fitted.refit(bootstrap=200, seed=3)["bootstrap"]
    assert (found["replicates"], found["failed"]) == (200, 0)
    np.testing.assert_allclose(values(found["standard_errors"]), values(job["standard_errors"]), rtol=0.25)
    assert fitted.refit(bootstrap=200, seed=3)["bootstrap"] == found
    assert fitted.refit(bootstrap=200, seed=4)["bootstrap"] != found
    assert fitted.refit()["bootstrap"] is None


HOSTILE = [
    ({"regressors": "temperature,nobody"}, "option"),
    ({"regressors": "auto,temperature"}, "option"),
    ({"regressors": "x" * 2001}, "invalid"),
    ({"without": "2022-02-20T00:00:00Z"}, "time"),
    ({"without": "2022-02-20T00:00:00Z/2022-02-20T00:00:00Z/2022-02-20T00:00:00Z"}, "time"),
    ({"without": "2022-02-20T00:00:00/2022-02-20T00:10:00"}, "time"),
    ({"without": "now/then"}, "time"),
    ({"without": "/"}, "time"),
    ({"without": "2022-02-20T00:10:00Z/2022-02-20T00:00:00Z"}, "option"),
    ({"without": "0001-01-01T00:00:00Z/9999-12-31T23:59:59Z"}, "option"),
    ({"without": ["2022-02-20T00:00:00Z/2022-02-20T00:00:01Z"] * 101}, "invalid"),
    ({"bootstrap": "10001"}, "invalid"),
    ({"bootstrap": "-1"}, "invalid"),
    ({"bootstrap": "NaN"}, "invalid"),
    ({"seed": str(2**63)}, "invalid"),
    ({"time_offset": "perhaps"}, "invalid"),
    ({"weights": "1"}, "extra_forbidden"),
]


@pytest.fixture(scope="module")
def kept(service, names) -> Fitted:
    """A set that no test changes."""
    with service.client() as api:
        name = next(names)
        api.post("/satellites", json={"id": name}).raise_for_status()
        api.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        yield fit(api, name)


@pytest.mark.parametrize(("query", "code"), HOSTILE, ids=lambda one: str(one)[:60])
def test_a_value_that_means_nothing_is_refused_by_name(kept, query, code):
    answer = kept.api.get(kept.path, params=query)
    assert (answer.status_code, answer.json()["code"]) == (422, code), answer.text


def test_a_column_that_the_moments_lack_is_refused_with_those_there_are(kept):
    answer = kept.api.get(kept.path, params={"regressors": "nobody"})
    assert "temperature, rumble" in answer.json()["detail"]


def test_the_most_that_may_be_asked_for_is_answered(kept):
    every = [f"2022-02-19T23:{minute:02d}:00Z/2022-02-19T23:{minute:02d}:01Z" for minute in range(50)] * 2
    found = kept.refit(without=every, bootstrap=10_000, regressors="auto")
    assert found["bootstrap"]["replicates"] == 10_000


def test_both_clients_ask_for_refits(service, kept):
    """Two spans are two values of one name."""
    query = {
        "bootstrap": "20",
        "without": ["2022-02-19T22:50:00Z/2022-02-19T22:55:00Z", "2022-02-19T23:00:00Z/2022-02-19T23:05:00Z"],
    }

    async def awaited() -> dict:
        async with AsyncClient(service.url, service.admin_key) as client:
            return await client.get(kept.path, **query)

    with Client(service.url, service.admin_key) as client:
        assert client.get(kept.path, **query) == run_apart(awaited()) == kept.refit(**query)


def test_a_method_without_moments_and_a_set_from_before_say_so(service, api, fitted):
    closed = calibrated(api, [fitted.session_id], method="vector-closed-form")
    with service.database.write() as session:
        session.execute(update(ParameterSet).where(ParameterSet.id == fitted.record["id"]).values(moments_sha256=None))
    for set_id in (closed["id"], fitted.record["id"]):
        answer = api.get(f"/parameter-sets/{set_id}/refit")
        assert (answer.status_code, answer.json()["code"]) == (404, "no_moments")
    with service.database.write() as session:
        DatabaseStore().delete(session, moments_key(fitted.record["id"]))


def test_moments_in_a_form_of_another_version_are_not_used(service, fitted):
    row_id = fitted.record["id"]
    with service.database.write() as session:
        DatabaseStore().delete(session, moments_key(row_id))
        other = DatabaseStore().put(session, moments_key(row_id), b"of another version")
        session.execute(update(ParameterSet).where(ParameterSet.id == row_id).values(moments_sha256=other))
    answer = fitted.api.get(fitted.path)
    assert (answer.status_code, answer.json()["code"]) == (404, "no_moments")
    assert "calibrate again" in answer.json()["detail"]


@pytest.mark.parametrize("store", ["database", "folder"])
def test_a_refit_outlives_the_telemetry_and_an_audit_guards_its_moments(new_service, tmp_path, store):
    url = None if store == "database" else f"file://{tmp_path}/store"
    service = new_service(workers=1, store_url=url)
    objects = service.services.store
    with service.client() as api:
        api.post("/satellites", json={"id": "old"}).raise_for_status()
        api.post("/satellites/old/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        fitted = fit(api, "old")
        before = fitted.refit(regressors="auto", bootstrap=50)
        api.patch("/satellites/old", json={"retention_days": 30}).raise_for_status()
        assert len(remove_expired(service.database, objects)) == 1
        assert api.get(f"/sessions/{fitted.session_id}/samples").json()["code"] == "expired"
        assert fitted.refit(regressors="auto", bootstrap=50) == before
        assert audit(service.database, objects).findings == ()
        key = moments_key(fitted.record["id"])
        with service.database.write() as session:
            assert key in set(objects.keys(session))
            objects.delete(session, key)
            objects.put(session, key, b"damaged")
        assert [(one.code, one.subject) for one in audit(service.database, objects).findings] == [
            ("stored_object_corrupt", key)
        ]
        broken = api.get(fitted.path)
        assert (broken.status_code, broken.json()["code"]) == (500, "stored_object_corrupt")
