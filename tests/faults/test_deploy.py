"""A new version rolled out under load (F21): each process is replaced while stations send and jobs run.

What speaks with the servers here does what a proxy does: it sends to one that is up and, where a connection fails,
the same bytes to the other.
"""

from __future__ import annotations

import hashlib
import random
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from faultsite import CSV, Site, piece, prepare, submit, upload, wait_for

SLOW = {"FAULT_CALCULATION": "slow", "PLANTED_S": "1"}
STATIONS = 4
PIECES = 5


class Servers:
    """The servers of a site that are up."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self.up: list[tuple[subprocess.Popen[bytes], str]] = []

    def add(self) -> str:
        """Start a server, with a worker of its own on SQLite, and return its address."""
        self.up.append(self.site.serve(workers=0 if self.site.is_postgres else 1, **SLOW))
        return self.up[-1][1]

    def replace_first(self) -> None:
        """Ask the server that has been up for longest to stop, wait for its end, and start another."""
        server, _ = self.up[0]
        server.terminate()
        assert server.wait(60) == 0
        del self.up[0]
        self.add()


class Sender:
    """One who sends requests to any server that is up, and to another where the connection fails."""

    def __init__(self, servers: Servers, number: int) -> None:
        self._servers = servers
        self._chance = random.Random(number)  # noqa: S311
        self._clients: dict[str, httpx2.Client] = {}
        self.statuses: Counter[int] = Counter()
        self.sent_again = 0
        self.longest_s = 0.0

    def ask(self, method: str, path: str, content: bytes = b"", **named: object) -> httpx2.Response:
        """Return the answer of the first server that gives one."""
        begun = time.monotonic()
        while time.monotonic() - begun < 60:
            _, url = self._chance.choice(self._servers.up)
            if url not in self._clients:
                self._clients[url] = self._servers.site.client(url)
            body = {"content": in_pieces(content)} if content else {}
            try:
                answer = self._clients[url].request(method, path, **body, **named)
            except httpx2.TransportError:
                self.sent_again += 1
                continue
            self.statuses[answer.status_code] += 1
            self.longest_s = max(self.longest_s, time.monotonic() - begun)
            return answer
        raise AssertionError("no server answered for a minute")

    def close(self) -> None:
        for client in self._clients.values():
            client.close()


def in_pieces(content: bytes) -> Iterator[bytes]:
    """Yield a body that takes a moment to come, so that some are always on their way."""
    size = len(content) // PIECES + 1
    for start in range(0, len(content), size):
        yield content[start : start + size]
        time.sleep(0.1)


@pytest.mark.timeout(300)
def test_a_rolling_deploy_under_load_fails_no_request_and_loses_nothing(site: Site, telemetry: bytes, record_property):
    """F21: both servers and the worker replaced one by one; no request fails, no byte is lost, no job runs again."""
    servers, is_over = Servers(site), threading.Event()
    url = servers.add()
    servers.add()
    workers = [site.worker(**SLOW)] if site.is_postgres else []
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]

    senders = [Sender(servers, number) for number in range(STATIONS + 1)]

    def station(number: int) -> set[str]:
        kept = set()
        while not is_over.is_set():
            content = piece(telemetry, number + STATIONS * len(kept))
            senders[number].ask("POST", "/satellites/a/sessions?magnetometer=m", content, headers=CSV)
            kept.add(hashlib.sha256(content).hexdigest())
        return kept

    def operator() -> list[str]:
        ask, jobs = senders[-1].ask, []
        body = {"kind": "calibration", "session_ids": [session_id]}
        while not is_over.is_set():
            once = {"idempotency-key": f"job-{len(jobs)}"}
            jobs.append(ask("POST", "/jobs", json=body, headers=once).json()["id"])
            while ask("GET", f"/jobs/{jobs[-1]}").json()["state"] in {"queued", "running"}:
                time.sleep(0.1)
        return jobs

    with ThreadPoolExecutor(STATIONS + 1) as pool:
        stations = [pool.submit(station, number) for number in range(STATIONS)]
        operating = pool.submit(operator)
        try:
            time.sleep(3.0)
            servers.replace_first()
            for worker in workers:
                site.worker(**SLOW)
                worker.terminate()
                assert worker.wait(60) == 0
            servers.replace_first()
            time.sleep(1.0)
        finally:
            is_over.set()
        kept, jobs = set[str]().union(*(one.result() for one in stations)), operating.result()
    statuses = sum((one.statuses for one in senders), Counter[int]())
    record_property("statuses", dict(statuses))
    record_property("sent_again", sum(one.sent_again for one in senders))
    record_property("longest_s", round(max(one.longest_s for one in senders), 2))
    for one in senders:
        one.close()
    assert set(statuses) <= {200, 201, 202}
    with site.client(servers.up[-1][1]) as api:
        ended = [api.get(f"/jobs/{job_id}").json() for job_id in jobs]
        assert [(one["state"], one["attempts"]) for one in ended] == [("succeeded", 1)] * len(jobs)
        assert len(api.get("/jobs", params={"limit": 1000}).json()["items"]) == len(jobs)
        assert len(api.get("/parameter-sets", params={"limit": 1000}).json()["items"]) == len(jobs)
        assert kept <= sessions_of(api)
    assert site.magcal("db", "audit") == 0


def sessions_of(api: httpx2.Client) -> set[str]:
    """Return the digest of every session."""
    found, cursor = set(), {}
    while True:
        part = api.get("/sessions", params={"limit": 1000} | cursor).json()
        found |= {one["sha256"] for one in part["items"]}
        if part["next"] is None:
            return found
        cursor = {"cursor": part["next"]}


def test_a_job_that_outlasts_the_grace_is_handed_back_and_not_counted_as_lost(site: Site, telemetry: bytes):
    """F21: the worker ends with status 0, and the next one takes the job at once, without waiting for its lease."""
    long = {"FAULT_CALCULATION": "slow", "PLANTED_S": "60", "MAGCAL_JOB_LEASE_S": "60"}
    _, url = site.serve(workers=0)
    worker = site.worker(FAULT_GRACE_S="1", **long)
    with site.client(url) as api:
        prepare(api)
        job_id = submit(api, upload(api, telemetry).json()["id"])
        wait_for(api, job_id, "running")
        worker.terminate()
        assert worker.wait(30) == 0
        assert api.get(f"/jobs/{job_id}").json()["state"] == "queued"
        site.worker()
        job = wait_for(api, job_id, "succeeded", "failed")
        assert (job["state"], job["attempts"]) == ("succeeded", 2)
        assert len(api.get("/parameter-sets").json()["items"]) == 1
