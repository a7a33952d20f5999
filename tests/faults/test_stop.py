"""Servers that are asked to stop, and a SQLite database that is destroyed and restored (F21, F23, F24)."""

from __future__ import annotations

import hashlib
import signal
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from faultsite import CSV, Site, prepare, submit, upload, wait_for


@pytest.fixture
def site(new_site: Callable[..., Site]) -> Site:
    return new_site()


def test_uploads_in_flight_are_kept_when_the_server_is_asked_to_stop(site: Site, telemetry: bytes):
    """F21: four bodies are half sent when SIGTERM comes; all four are acknowledged, and the server ends with 0."""
    server, url = site.serve(workers=0)
    asked, half_sent = threading.Event(), threading.Barrier(5)
    lines = telemetry.splitlines(keepends=True)

    def station(number: int) -> int:
        content = b"".join(lines[: 100 + number])

        def body() -> Iterator[bytes]:
            yield content[:1000]
            half_sent.wait(30)
            asked.wait(30)
            yield content[1000:]

        with site.client(url) as api:
            answer = api.post(
                "/satellites/a/sessions", params={"magnetometer": "m"}, content=body(), headers=CSV, timeout=60
            )
            return answer.status_code

    with site.client(url) as api:
        prepare(api)
    with ThreadPoolExecutor(4) as pool:
        stations = [pool.submit(station, number) for number in range(4)]
        half_sent.wait(30)
        with site.client(url) as api:  # asked after the four, so that once it is answered they have been accepted
            api.get("/satellites").raise_for_status()
        server.send_signal(signal.SIGTERM)
        asked.set()
        assert [one.result() for one in stations] == [201] * 4
    assert server.wait(60) == 0
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        assert len(api.get("/sessions").json()["items"]) == 4


@pytest.mark.timeout(300)
def test_a_worker_killed_while_it_writes_its_result_leaves_no_half_of_it(site: Site, telemetry: bytes):
    """F24: killed between the rows of result and state and their commit; the next attempt makes the one result."""
    short = {"MAGCAL_JOB_LEASE_S": "2", "MAGCAL_JOB_HEARTBEAT_S": "0.5"}
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
        job_id = submit(api, upload(api, telemetry).json()["id"])
        dying = site.worker(FAULT_POINT="in_result", **short)
        assert dying.wait(90) == -signal.SIGKILL
        assert api.get("/parameter-sets").json()["items"] == []
        assert api.get(f"/jobs/{job_id}").json()["state"] == "running"
        site.worker(**short)
        job = wait_for(api, job_id, "succeeded", "failed")
        assert (job["state"], job["attempts"]) == ("succeeded", 2)
        assert len(api.get("/parameter-sets").json()["items"]) == 1
    assert site.magcal("db", "audit") == 0


def test_a_destroyed_sqlite_database_is_restored_from_its_backup(site: Site, telemetry: bytes):
    """F23: saved while it runs, destroyed, restored as `docs/deployment.md` says; the audit finds nothing amiss."""
    server, url = site.serve(workers=0)
    database, backup = site.folder / "data" / "magcal.db", site.folder / "backup.db"
    with site.client(url) as api:
        prepare(api)
        kept = upload(api, telemetry).json()
        with sqlite3.connect(database) as source, sqlite3.connect(backup) as target:
            source.backup(target)
        source.close()
        target.close()
        after = upload(api, telemetry + b"\n").json()
    server.terminate()
    assert server.wait(60) == 0
    for name in ("magcal.db", "magcal.db-wal", "magcal.db-shm"):
        (site.folder / "data" / name).unlink(missing_ok=True)
    database.write_bytes(backup.read_bytes())
    assert site.magcal("db", "audit") == 0
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        assert api.get(f"/sessions/{kept['id']}").json()["sha256"] == hashlib.sha256(telemetry).hexdigest()
        assert api.get(f"/sessions/{after['id']}").status_code == 404
        assert upload(api, telemetry + b"\n").status_code == 201
    assert httpx2.get(f"{url}/readyz", trust_env=False).status_code == 200
