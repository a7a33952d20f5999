"""A database that restarts, refuses, dies or is restored (F5, F8, F9, F23): real processes over PostgreSQL."""

from __future__ import annotations

import hashlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx2
import psycopg
import pytest
from database_server import DatabaseServer, database_server
from faultsite import Site, prepare, submit, upload, wait_for

pytestmark = pytest.mark.postgres

LOSES = """
CREATE SEQUENCE losses;
CREATE FUNCTION lose() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF nextval('losses') % {every} <> 0 THEN
        RAISE EXCEPTION 'planted' USING ERRCODE = '{code}';
    END IF;
    RETURN NEW;
END $$;
CREATE TRIGGER lose BEFORE INSERT ON audit_event FOR EACH ROW EXECUTE FUNCTION lose();
"""
"""Lets the server itself end transactions as losers of a conflict; a sequence counts those rolled back too."""


@pytest.fixture(scope="module")
def server() -> Iterator[DatabaseServer]:
    with database_server() as server:
        yield server


@pytest.fixture
def site(server: DatabaseServer, new_site: Callable[..., Site]) -> Site:
    server.create()
    return new_site(server.url)


@pytest.mark.timeout(300)
def test_a_restart_of_the_database_costs_no_byte_and_no_lease(site: Site, server: DatabaseServer, telemetry: bytes):
    """F8: 503 with Retry-After while it lasts, never 500; uploads go on within 5 s; the job is not run again."""
    _, url = site.serve(workers=0)
    site.worker(FAULT_CALCULATION="slow", PLANTED_S="8")
    lines = telemetry.splitlines(keepends=True)
    is_over = threading.Event()

    def station(number: int) -> tuple[Counter[int], list[float], set[str]]:
        met, times, kept = Counter[int](), [], set[str]()
        with site.client(url) as api:
            while not is_over.is_set():
                content = b"".join(lines[: 20 + number + 4 * len(kept)])
                answer = upload(api, content)
                met[answer.status_code] += 1
                if answer.status_code == 503:
                    assert int(answer.headers["retry-after"]) > 0
                    time.sleep(0.1)
                    continue
                kept.add(hashlib.sha256(content).hexdigest())
                times.append(time.monotonic())
        return met, times, kept

    with site.client(url) as api:
        prepare(api)
        job_id = submit(api, upload(api, telemetry).json()["id"])
        wait_for(api, job_id, "running")
        with ThreadPoolExecutor(4) as pool:
            stations = [pool.submit(station, number) for number in range(4)]
            time.sleep(1.0)
            server.restart()
            ready_at = time.monotonic()
            job = wait_for(api, job_id, "succeeded", "failed")
            is_over.set()
            found = [one.result() for one in stations]
        assert (job["state"], job["attempts"]) == ("succeeded", 1), job["error"]
        assert set().union(*(set(met) for met, _, _ in found)) <= {200, 201, 503}
        assert min(at for _, times, _ in found for at in times if at > ready_at) - ready_at < 5.0
        sessions = {one["sha256"] for one in api.get("/sessions", params={"limit": 1000}).json()["items"]}
        assert set().union(*(kept for _, _, kept in found)) <= sessions
    assert site.magcal("db", "audit") == 0


@pytest.mark.parametrize("code", ["40001", "40P01", "55P03"])
def test_a_transaction_that_loses_is_tried_three_times_more(site: Site, telemetry: bytes, code: str):
    """F9: serialization failure, deadlock, lock not had: three losses cost nothing, with the fourth it is 503."""
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
        with psycopg.connect(site.environment["MAGCAL_DATABASE_URL"], autocommit=True) as connection:
            connection.execute(LOSES.format(every=4, code=code).encode())
            assert api.post("/satellites", json={"id": "b"}).status_code == 201
            sent = upload(api, telemetry)
            assert sent.status_code == 201
            assert upload(api, telemetry).json()["id"] == sent.json()["id"]
            asked = {"kind": "calibration", "session_ids": [sent.json()["id"]]}
            assert api.post("/jobs", json=asked).status_code == 202
            connection.execute("DROP FUNCTION lose CASCADE; DROP SEQUENCE losses")
            connection.execute(LOSES.format(every=1_000_000, code=code).encode())
            for answer in (api.post("/satellites", json={"id": "c"}), upload(api, telemetry + b"\n")):
                assert (answer.status_code, answer.json()["code"]) == (503, "unavailable")
                assert int(answer.headers["retry-after"]) > 0
        assert len(api.get("/sessions").json()["items"]) == 1
        assert len(api.get("/jobs").json()["items"]) == 1
        assert {one["id"] for one in api.get("/satellites").json()["items"]} == {"a", "b"}


@pytest.mark.timeout(600)
def test_jobs_that_the_queue_has_lost_sight_of_are_handed_out_again(site: Site, telemetry: bytes):
    """F1: one that waits and one whose worker is gone, without the queue's rows; the sweep finds both."""
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        waits, lost = submit(api, session_id), submit(api, session_id)
        with psycopg.connect(site.environment["MAGCAL_DATABASE_URL"], autocommit=True) as connection:
            connection.execute("DELETE FROM procrastinate_jobs")
            connection.execute("UPDATE job SET created_at = created_at - interval '2 minutes'")
            taken = "UPDATE job SET state = 'running', attempts = 1, lease_until = now() - interval '1 minute'"
            connection.execute(f"{taken} WHERE id = %s".encode(), (lost,))
        worker = site.worker()
        found = [wait_for(api, one, "succeeded", "failed", timeout_s=240) for one in (waits, lost)]
    assert [(job["state"], job["attempts"]) for job in found] == [("succeeded", 1), ("succeeded", 2)]
    assert not [one for one in site.log(worker) if one["event"] == "sweep_failed"]


def test_of_many_that_make_the_same_thing_one_makes_it(site: Site):
    """F9: rows that two transactions make at once are a conflict of the second, not an error of the service."""
    urls = [site.serve(workers=0)[1], site.serve(workers=0)[1]]

    def make(number: int) -> list[int]:
        body = {"id": "same", "unit": "nT"}
        with site.client(urls[number % 2]) as api:
            satellites = [api.post("/satellites", json={"id": f"s{i}"}).status_code for i in range(10)]
            return [*satellites, api.post("/satellites/s0/magnetometers", json=body).status_code]

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(make, range(8)))
    for column in zip(*found, strict=True):
        assert sorted(column) == [201] + [409] * 7


@pytest.mark.timeout(300)
def test_a_destroyed_database_is_restored_from_its_backup(site: Site, server: DatabaseServer, telemetry: bytes):
    """F23: saved while it runs, destroyed, restored: everything up to the backup, and an audit without a finding."""
    api_server, url = site.serve(workers=0)
    worker = site.worker()
    with site.client(url) as api:
        prepare(api)
        session = upload(api, telemetry).json()
        job = wait_for(api, submit(api, session["id"]), "succeeded")
        waiting = submit(api, session["id"])
        backup = server.dump()
        after = upload(api, telemetry + b"\n").json()
        wait_for(api, waiting, "succeeded")
    for process in (api_server, worker):
        process.terminate()
        assert process.wait(60) == 0
    server.restore(backup)
    assert site.magcal("db", "audit") == 0
    _, url = site.serve(workers=0)
    site.worker()
    with site.client(url) as api:
        assert api.get(f"/sessions/{after['id']}").status_code == 404
        assert api.get(f"/sessions/{session['id']}").json()["sha256"] == hashlib.sha256(telemetry).hexdigest()
        found = api.get("/parameter-sets", params={"job": job["id"]}).json()["items"]
        assert [one["id"] for one in found] == [job["result"]["parameter_set_id"]]
        assert wait_for(api, waiting, "succeeded")["attempts"] >= 1  # it waited or ran when the backup was made
        assert upload(api, telemetry + b"\n").status_code == 201
    assert httpx2.get(f"{url}/readyz", trust_env=False).status_code == 200
    assert site.magcal("db", "audit") == 0


@pytest.mark.timeout(300)
def test_everything_acknowledged_survives_the_kill_of_everything(site: Site, server: DatabaseServer, telemetry: bytes):
    """F5: every process of the service and of the database killed at once, in the middle of uploads and of a job."""
    processes = [site.serve(workers=0), (site.worker(FAULT_CALCULATION="slow"), "")]
    url = processes[0][1]
    lines = telemetry.splitlines(keepends=True)
    acknowledged: set[str] = set()

    def station(number: int) -> None:
        with site.client(url) as api:
            for i in range(1000):
                content = b"".join(lines[: 20 + number + 4 * i])
                try:
                    answer = upload(api, content)
                except httpx2.TransportError:
                    return
                if answer.status_code == 201:
                    acknowledged.add(hashlib.sha256(content).hexdigest())
                time.sleep(0.01)

    with site.client(url) as api:
        prepare(api)
        submit(api, upload(api, telemetry).json()["id"])
    with ThreadPoolExecutor(4) as pool:
        stations = [pool.submit(station, number) for number in range(4)]
        time.sleep(2.0)
        for process, _ in processes:
            process.kill()
        server.kill()
        for one in stations:
            one.result()
    server.start()
    assert acknowledged
    assert site.magcal("db", "audit") == 0
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        kept = {one["sha256"] for one in api.get("/sessions", params={"limit": 1000}).json()["items"]}
        assert acknowledged <= kept
