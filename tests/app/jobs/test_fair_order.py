"""Whose job is next: rounds of the satellites, each satellite's jobs in their order, on both queues (L8)."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator

import pytest

from app.jobs.engines.open_engine import open_engine
from app.jobs.execution.leases import claim_next, finish, lapsed_by_clock
from app.jobs.fair_order import ROUNDS, take_turns
from app.jobs.tables import Job
from app.satellites.tables import Satellite
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.migration import upgrade
from app.storage.open_store import open_store
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples


@pytest.fixture
def database(tmp_path) -> Iterator[Database]:
    settings = Settings(data_dir=tmp_path)
    opened = Database(settings)
    upgrade(opened, settings)
    with opened.write() as session:
        session.add_all(Satellite(id=name, created_at=utc_now()) for name in "abc")
    yield opened
    opened.close()


def enqueue(database: Database, satellite_id: str | None, count: int, priority: int = 0) -> list[str]:
    """Return the ids of new jobs, in their order."""
    plain = {"kind": "calibration", "state": "queued", "request": {}, "progress": 0.0, "attempts": 0}
    jobs = [
        Job(
            id=new_id(),
            satellite_id=satellite_id,
            priority=priority,
            lost_attempts=0,
            cancel_requested=False,
            created_at=utc_now(),
            **plain,
        )
        for _ in range(count)
    ]
    with database.write() as session:
        take_turns(session, jobs)
        session.add_all(jobs)
    return [job.id for job in jobs]


def work_off(database: Database, most: int = 1000) -> list[str]:
    """Return the ids of the jobs in the order in which one worker takes them."""
    order = []
    while len(order) < most:
        with database.write() as session:
            claim = claim_next(session, "worker", 10.0, 3, lapsed_by_clock())
            if claim is None:
                break
            finish(session, claim, "succeeded", result={})
        order.append(claim.job_id)
    return order


def test_no_satellite_waits_longer_than_twice_its_share(database):
    """A has 60 jobs when B and C come with 5 each: of three that share, the k-th job has its turn by place 3 k."""
    bulk = enqueue(database, "a", 60)
    order = work_off(database, 10)
    b, c = enqueue(database, "b", 5), enqueue(database, "c", 5)
    place = {job_id: number for number, job_id in enumerate(work_off(database), start=1)}
    for k in range(5):
        assert place[b[k]] <= 2 * 3 * (k + 1)
        assert place[c[k]] <= 2 * 3 * (k + 1)
    assert max(place[one] for one in (*b, *c)) <= 3 * 5
    assert order == bulk[:10]
    assert [one for one in sorted(place, key=place.__getitem__) if one in set(bulk)] == bulk[10:]


def test_each_satellite_s_jobs_run_in_their_order_and_higher_priorities_first(database):
    late, early = enqueue(database, "a", 3, priority=-50), enqueue(database, "a", 3)
    urgent = enqueue(database, "b", 2, priority=10)
    more = enqueue(database, "a", 2)
    assert work_off(database) == [*urgent, *early, *more, *late]


def test_who_comes_again_and_again_does_not_push_others_back(database):
    """B asks anew whenever its job is done; A's jobs still get every second turn."""
    bulk = enqueue(database, "a", 10)
    order = []
    for _ in range(20):
        enqueue(database, "b", 1)
        order += work_off(database, 1)
    taken = Counter("a" if one in set(bulk) else "b" for one in order)
    assert taken["a"] == 10


def test_an_empty_queue_begins_anew_and_a_full_one_stays_in_its_priority(database):
    enqueue(database, "a", 5)
    work_off(database)
    again = enqueue(database, "a", 1)[0]
    with database.write() as session:
        row = session.get_one(Job, again)
        assert row.rank == 0
        row.rank = ROUNDS - 1
    last = enqueue(database, "a", 2)
    lower = enqueue(database, "b", 1, priority=-1)
    with database.read() as session:
        assert [session.get_one(Job, one).rank for one in (*last, *lower)] == [ROUNDS - 1, ROUNDS - 1, ROUNDS]
    order = work_off(database)
    assert (set(order[:3]), order[3:]) == ({again, *last}, lower)


def test_jobs_without_a_satellite_take_turns_with_the_others(database):
    bulk = enqueue(database, "a", 10)
    studies = enqueue(database, None, 3)
    order = work_off(database)
    assert [order.index(one) for one in studies] == [1, 3, 5]
    assert [one for one in order if one in set(bulk)] == bulk


@pytest.mark.postgres
def test_every_kind_of_job_has_its_turn_on_postgresql(new_service, postgres_url: str):
    """A history is reprocessed when a study of the attitude, one of the energy and a pass come: none waits for all."""
    service = new_service(database_url=postgres_url)
    telemetry = write_samples(simulated(SESSIONS[0], 200).samples, "csv").splitlines(keepends=True)
    with service.client() as api:
        for name in "abc":
            api.post("/satellites", json={"id": name}).raise_for_status()
            api.post(f"/satellites/{name}/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
            tle = {"content": tle_text(), "headers": {"content-type": "text/plain"}}
            api.post(f"/satellites/{name}/orbits", **tle).raise_for_status()
        where = {"params": {"magnetometer": "m"}, "headers": {"content-type": "text/csv"}}
        sent = [
            api.post(f"/satellites/{name}/sessions", content=b"".join(telemetry[: 200 - i]), **where).json()["id"]
            for name, count in (("a", 8), ("c", 1))
            for i in range(count)
        ]
        history = api.post("/reprocessings", json={"satellites": ["a"], "priority": 0}).json()["id"]
        asked = [
            {"kind": "attitude-simulation", "satellite": "b", "duration_s": 600},
            {"kind": "energy-balance", "satellite": "b", "duration_s": 3600, "step_s": 60, "propagator": "sgp4"},
            {"kind": "calibration", "session_ids": [sent[-1]]},
        ]
        single = [api.post("/jobs", json=body).raise_for_status().json()["id"] for body in asked]
        store = open_store(service.settings)
        workers = open_engine(service.database, store, service.settings, 1).workers
        assert workers is not None
        workers.start()
        try:
            deadline = time.monotonic() + 120
            while (job := api.get(f"/jobs/{history}").json())["state"] == "running":
                assert time.monotonic() < deadline, job
                time.sleep(0.1)
        finally:
            workers.stop(20.0)
        assert job["result"] == {"succeeded": 8, "failed": 0, "cancelled": 0}
        ended = [api.get(f"/jobs/{one}").json() for one in single]
        assert [(one["state"], one["attempts"]) for one in ended] == [("succeeded", 1)] * 3, ended
        children = api.get("/jobs", params={"parent": history}).json()["items"]
        order = sorted([*children, *ended], key=lambda one: one["started_at"])
        places = [order.index(one) for one in ended]
        assert places == [1, 4, 2]  # rounds: a b c, a b, then a alone
        assert [one["session_ids"] for one in order if one["satellite"] == "a"] == [[one] for one in sent[:8]]
