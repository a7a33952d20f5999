"""Two writers at once on PostgreSQL: what one reads before it decides, the other may not change meanwhile."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import func, select

from app.access.caller import SYSTEM
from app.access.idempotency import IdempotencyKey
from app.jobs.engines.embedded import EmbeddedQueue
from app.jobs.execution.leases import LostClaimError, claim_one, finish, hand_back
from app.jobs.repository import JobRepository
from app.jobs.tables import Job
from app.parameter_sets.json_listing import Texts
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import Activation, ParameterSet
from app.satellites.tables import Magnetometer, Satellite
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.migration import upgrade
from app.storage.retry import retried

pytestmark = pytest.mark.postgres
BLOCKED_S = 0.5
"""Whoever waits for a lock has not ended after so long."""
CSV = {"content-type": "text/csv"}


@pytest.fixture
def database(tmp_path: Path, postgres_url: str) -> Iterator[Database]:
    settings = Settings(data_dir=tmp_path, database_url=postgres_url)
    opened = Database(settings)
    upgrade(opened, settings)
    with opened.write() as session:
        session.add(Satellite(id="a", created_at=utc_now()))
        session.flush()
        session.add(Magnetometer(satellite_id="a", id="m", unit="nT", created_at=utc_now()))
    yield opened
    opened.close()


def new_job(database: Database, **values: object) -> str:
    plain = {
        "id": new_id(), "kind": "calibration", "state": "queued", "priority": 0, "rank": 0, "satellite_id": "a",
        "magnetometer_id": "m", "request": {}, "progress": 0.0, "attempts": 0, "lost_attempts": 0,
        "cancel_requested": False, "created_at": utc_now(),
    }  # fmt: skip
    with database.write() as session:
        row = Job(**(plain | values))
        session.add(row)
        return row.id


def new_set(database: Database) -> str:
    job_id = new_job(database, state="succeeded", result={})
    with database.write() as session:
        row = ParameterSet(
            id=new_id(), satellite_id="a", magnetometer_id="m", job_id=job_id, status="candidate", grade="accept",
            method="scalar", data_from=utc_now(), data_until=utc_now(), record={}, residuals_sha256="0" * 64,
            created_at=utc_now(),
        )  # fmt: skip
        session.add(row)
        return row.id


@dataclass
class Second:
    """A second writer that begins while the first has not committed, and ends when it has."""

    pool: ThreadPoolExecutor

    def __call__(self, work: Callable[[], object]) -> Future[object]:
        future = self.pool.submit(work)
        with pytest.raises(TimeoutError):
            future.result(BLOCKED_S)  # it waits: where it did not, it has decided by what the first is changing
        return future


@pytest.fixture
def second() -> Iterator[Second]:
    with ThreadPoolExecutor(1) as pool:
        yield Second(pool)


def test_the_last_two_calibrations_that_end_at_once_end_their_reprocessing(database, second):
    parent = new_job(database, kind="reprocessing", state="running")
    children = [new_job(database, parent_id=parent) for _ in range(2)]
    claims = []
    for child in children:
        with database.write() as session:
            claims.append(claim_one(session, child, "worker", 60.0, 3))

    def end_second() -> None:
        with database.write() as session:
            finish(session, claims[1], "succeeded", result={})

    with database.write() as session:
        finish(session, claims[0], "succeeded", result={})
        ending = second(end_second)
    ending.result(20)
    with database.read() as session:
        row = session.get_one(Job, parent)
        assert (row.state, row.result) == ("succeeded", {"succeeded": 2, "failed": 0, "cancelled": 0})


def test_a_claim_that_another_attempt_has_taken_over_is_not_handed_back(database):
    job_id = new_job(database)
    with database.write() as session:
        first = claim_one(session, job_id, "first", -1.0, 3)  # its lease is over at once
    with database.write() as session:
        claim = claim_one(session, job_id, "second", 60.0, 3)
    assert claim is not None
    assert claim.attempt == 2
    with pytest.raises(LostClaimError), database.write() as session:
        hand_back(session, first, is_lost=True)
    with database.read() as session:
        row = session.get_one(Job, job_id)
        assert (row.state, row.worker, row.lost_attempts) == ("running", "second", 1)


def test_a_job_that_is_handed_back_while_it_is_cancelled_is_cancelled(database, second):
    job_id = new_job(database)
    with database.write() as session:
        claim = claim_one(session, job_id, "worker", 60.0, 3)

    def cancel() -> None:
        with database.write() as session:
            JobRepository(session, SYSTEM).cancel(job_id)

    with database.write() as session:
        hand_back(session, claim, is_lost=False)
        cancelling = second(cancel)
    cancelling.result(20)
    with database.read() as session:
        assert session.get_one(Job, job_id).state == "cancelled"


def test_two_activations_of_one_set_at_once_are_one_and_can_be_rolled_back(database, second):
    before, after = new_set(database), new_set(database)
    with database.write() as session:
        ParameterSetRepository(session, SYSTEM).activate(before, force=False)

    def activate() -> None:
        with database.write() as session:
            ParameterSetRepository(session, SYSTEM).activate(after, force=False)

    with database.write() as session:
        ParameterSetRepository(session, SYSTEM).activate(after, force=False)
        activating = second(activate)
    activating.result(20)
    with database.write() as session:
        ParameterSetRepository(session, SYSTEM).rollback(after)
    with database.read() as session:
        assert session.get_one(ParameterSet, before).status == "active"
        assert session.get_one(ParameterSet, after).status == "retired"
        assert session.scalar(select(func.count()).select_from(Activation)) == 3  # before, after, before again


def test_fifty_clients_that_activate_and_roll_back_leave_one_set_in_force(database):
    sets = [new_set(database) for _ in range(3)]
    begin = threading.Barrier(10)

    def activate(set_id: str) -> None:
        with database.write() as session:
            ParameterSetRepository(session, SYSTEM).activate(set_id, force=False)

    def go(number: int) -> None:
        begin.wait()
        for i in range(5):
            retried(lambda i=i: activate(sets[(number + i) % 3]))  # as a request is: who waits too long tries again

    with ThreadPoolExecutor(10) as pool:
        for future in [pool.submit(go, number) for number in range(10)]:
            future.result(60)
    with database.read() as session:
        rows = session.scalars(select(Activation).order_by(Activation.begun_at, Activation.id)).all()
        names = {row.id: row.parameter_set_id for row in rows}
        assert [row.id for row in rows if row.ended_at is None] == [rows[-1].id]
        assert all(row.previous_id is None or names[row.previous_id] != row.parameter_set_id for row in rows)
        assert (
            session.scalar(select(func.count()).select_from(ParameterSet).where(ParameterSet.status == "active")) == 1
        )


@pytest.mark.parametrize("path", ["/jobs", "/reprocessings"])
def test_one_idempotency_key_over_two_servers_makes_one_job(new_service, postgres_url, path):
    """Eight clients at once, five times: one job for each key; whoever does not get it is told to come again."""
    services = [new_service(database_url=postgres_url) for _ in range(2)]
    key = services[0].key("operate", "ingest", "read")
    clients = [service.client(key) for service in services for _ in range(4)]
    with services[0].client(services[0].admin_key) as admin:
        admin.post("/satellites", json={"id": "a"}).raise_for_status()
        admin.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        content = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"
        sent = admin.post("/satellites/a/sessions?magnetometer=m", content=content, headers=CSV)
    body = {"kind": "calibration", "session_ids": [sent.json()["id"]]} if path == "/jobs" else {"satellites": ["a"]}
    statuses: Counter[int] = Counter()
    for client in clients:  # a first request builds a route, under filters of warnings that threads share
        assert client.post(path, json={"unknown": 1}).status_code == 422
    for number in range(5):
        begin = threading.Barrier(len(clients))

        def ask(client, number=number, begin=begin):
            begin.wait()
            return client.post(path, json=body, headers={"idempotency-key": f"key-{number}"})

        with ThreadPoolExecutor(len(clients)) as pool:
            answers = list(pool.map(ask, clients))
        statuses.update(one.status_code for one in answers)
        made = {one.json()["id"] for one in answers if one.status_code == 202}
        assert len(made) == 1, [one.text for one in answers]
        assert {one.status_code for one in answers} <= {202, 409}
        assert all("retry-after" in one.headers for one in answers if one.status_code == 409)
        assert ask(clients[-1], begin=threading.Barrier(1)).json()["id"] in made
    kind = "calibration" if path == "/jobs" else "reprocessing"
    with services[0].database.read() as session:
        assert session.scalar(select(func.count()).select_from(Job).where(Job.kind == kind)) == 5
        assert session.scalar(select(func.count()).select_from(IdempotencyKey)) == 5
    for client in clients:
        client.close()


def test_a_claim_is_handed_out_once_by_the_embedded_queue_too(tmp_path):
    """The same on SQLite: the executor's way back checks that the claim still holds before it enqueues."""
    settings = Settings(data_dir=tmp_path)
    opened = Database(settings)
    upgrade(opened, settings)
    with opened.write() as session:
        session.add(Satellite(id="a", created_at=utc_now()))
    job_id = new_job(opened, magnetometer_id=None)
    with opened.write() as session:
        first = claim_one(session, job_id, "first", -1.0, 3)
    with opened.write() as session:
        claim_one(session, job_id, "second", 60.0, 3)
    with pytest.raises(LostClaimError), opened.write() as session:
        hand_back(session, first, is_lost=False)
        EmbeddedQueue().enqueue(session, [session.get_one(Job, job_id)])
    opened.close()


def test_threads_that_list_at_once_share_one_cache(monkeypatch):
    """Eight threads, a cache that is always full: no error, and its size is that of what it holds."""
    monkeypatch.setattr("app.parameter_sets.json_listing.MOST_BYTES", 2000)
    monkeypatch.setattr(
        "app.parameter_sets.json_listing._written", lambda _connection, sets: dict.fromkeys(sets.items(), b"x" * 100)
    )
    texts = Texts()
    begin = threading.Barrier(8)

    def ask(number: int) -> None:
        begin.wait()
        for i in range(3000):
            sets = [(str((number * 7 + i + j) % 60), "candidate") for j in range(10)]
            assert len(texts.of(None, sets)) == 10

    with ThreadPoolExecutor(8) as pool:
        for future in [pool.submit(ask, number) for number in range(8)]:
            future.result(60)
    assert texts._size == sum(map(len, texts._texts.values())) <= 2000
