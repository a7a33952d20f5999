"""While releases are rolled out, no worker takes a job whose request a later release has written."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator

import pytest
from sqlalchemy import select, update

from app.jobs.engines.open_engine import open_engine
from app.jobs.execution.leases import claim_next, claim_one, is_work_waiting, lapsed_by_clock
from app.jobs.kinds.registry import JOB_KINDS
from app.jobs.request_version import QUEUES, REQUEST_VERSION, queue_of
from app.jobs.tables import Job
from app.jobs.transitions import new_job
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import upgrade
from app.storage.open_store import open_store
from magcal_core.attitude.options import RomOptions

LEASE_S, MOST_LOST = 10.0, 3
LATER = REQUEST_VERSION + 1
KNOWN = {2: "b3587ab52533cfe1"}
"""A digest of what a request of each version may say."""


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def settings(request: pytest.FixtureRequest, tmp_path) -> Settings:
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres_url")
    return Settings(data_dir=tmp_path, database_url=url, store_url=f"file://{tmp_path}/objects", min_free_mb=0)


@pytest.fixture
def database(settings) -> Iterator[Database]:
    opened = Database(settings)
    upgrade(opened, settings)
    yield opened
    opened.close()


def put(database: Database, *versions: int) -> list[str]:
    """Return the ids of waiting jobs, one of each version."""
    jobs = [new_job("energy-balance", 0, {}, "tests") for _ in versions]
    with database.write() as session:
        for job, version in zip(jobs, versions, strict=True):
            job.request_version = version
            session.add(job)
        session.flush()
        return [job.id for job in jobs]


def test_a_job_of_a_later_release_is_left_to_a_worker_that_knows_it(database):
    later, own, before = put(database, LATER, REQUEST_VERSION, 1)
    with database.write() as session:
        assert claim_one(session, later, "w", LEASE_S, MOST_LOST) is None
        taken = [claim_next(session, "w", LEASE_S, MOST_LOST, None) for _ in range(3)]
        assert {None if one is None else one.job_id for one in taken} == {own, before, None}
        assert not is_work_waiting(session, None)


def test_nor_is_it_taken_over_from_a_worker_that_is_lost(database):
    (later,) = put(database, LATER)
    with database.write() as session:
        session.execute(update(Job).values(state="running", attempts=1, lease_until=Job.created_at))
    with database.write() as session:
        assert claim_one(session, later, "w", LEASE_S, MOST_LOST) is None
        assert claim_next(session, "w", LEASE_S, MOST_LOST, lapsed_by_clock()) is None
        assert session.scalars(select(Job.state)).one() == "running"


def test_workers_go_past_it(database, settings):
    """Real workers: on PostgreSQL they do not hear of it at all."""
    store = open_store(settings)
    queue = open_engine(database, store, settings, 0).queue
    jobs = [new_job("attitude-simulation", 0, RomOptions(duration_s=600.0).to_dict(), "tests") for _ in range(3)]
    jobs[0].request_version = LATER
    with database.write() as session:
        queue.enqueue(session, jobs)
        later, *known = [job.id for job in jobs]
    engine = open_engine(database, store, settings, 1)
    assert engine.workers is not None
    engine.workers.start()
    try:
        deadline, states = time.monotonic() + 60.0, dict[str, str]()
        while any(states.get(one) not in {"succeeded", "failed"} for one in known) and time.monotonic() < deadline:
            time.sleep(0.1)
            with database.read() as session:
                states = {one.id: one.state for one in session.execute(select(Job.id, Job.state))}
        assert states == {later: "queued"} | dict.fromkeys(known, "succeeded")
    finally:
        engine.workers.stop(5.0)


def test_each_version_has_a_queue_that_workers_of_earlier_releases_do_not_listen_to():
    """The first release's workers listen to `magcal` alone, and its servers put their jobs there."""
    assert QUEUES[0] == "magcal"
    assert queue_of(REQUEST_VERSION) == QUEUES[-1]
    assert queue_of(LATER) not in QUEUES
    assert len(set(QUEUES)) == REQUEST_VERSION


def said(schema: object) -> object:
    """Return what a JSON schema allows: names, types and values, not how they are described."""
    if isinstance(schema, list):
        return sorted((said(one) for one in schema), key=json.dumps)
    if not isinstance(schema, dict):
        return schema
    left_out = {"description", "title", "examples", "default"}
    return {
        key: {name: said(one) for name, one in value.items()} if key in {"properties", "$defs"} else said(value)
        for key, value in sorted(schema.items())
        if key not in left_out
    }


def test_what_a_request_may_say_has_a_version_of_its_own():
    """A worker of the release before would end such a job as failed: raise `REQUEST_VERSION`, and give its digest here.

    Within one release that is not out yet, the digest alone is brought up to date.
    """
    bodies = {name: said(kind.body.model_json_schema()) for name, kind in sorted(JOB_KINDS.items())}
    digest = hashlib.sha256(json.dumps(bodies, sort_keys=True).encode()).hexdigest()[:16]
    assert KNOWN[REQUEST_VERSION] == digest
