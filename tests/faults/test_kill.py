"""Killed, paused and doubled processes: what was acknowledged is kept, and every job has one result (F1-F4, F10)."""

from __future__ import annotations

import hashlib
import random
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest
from faultsite import CSV, SEED, TRIALS, Site, piece, prepare, submit, upload, wait_for

ALL = {"limit": 1000}
STATIONS = 4
LONG = pytest.mark.timeout(600 + 60 * TRIALS)


def results(api, job_id) -> list[dict]:
    return api.get("/parameter-sets", params={"job": job_id}).json()["items"]


@LONG
def test_a_killed_worker_loses_no_job_and_doubles_no_result(site: Site, telemetry: bytes, record_property):
    """F1: the job restarts within 15 s of the kill, and gives the numbers of an undisturbed one."""
    chance = random.Random(SEED)  # noqa: S311
    slow = {"FAULT_CALCULATION": "slow", "PLANTED_S": "2"}
    server, url = site.serve(workers=0)
    working = {worker.pid: worker for worker in (site.worker(**slow), site.worker(**slow))}
    restarts_s = []
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        undisturbed = wait_for(api, submit(api, session_id), "succeeded")
        for _ in range(TRIALS):
            job_id = submit(api, session_id)
            job = wait_for(api, job_id, "running")
            time.sleep(chance.uniform(0.0, 1.8))
            victim = working.pop(int(str(job["worker"]).split(":")[1]))
            victim.kill()
            killed_at = time.monotonic()
            while api.get(f"/jobs/{job_id}").json()["attempts"] < 2:
                assert time.monotonic() - killed_at < 30.0
                time.sleep(0.05)
            restarts_s.append(round(time.monotonic() - killed_at, 1))
            assert restarts_s[-1] <= 15.0
            job = wait_for(api, job_id, "succeeded", "failed")
            assert (job["state"], job["attempts"]) == ("succeeded", 2), job["error"]
            found = results(api, job_id)
            assert [one["id"] for one in found] == [job["result"]["parameter_set_id"]]
            expected = results(api, undisturbed["id"])[0]
            assert found[0]["parameters"] == expected["parameters"]
            assert found[0]["covariance"] == expected["covariance"]
            standby = site.worker(**slow)
            working[standby.pid] = standby
    record_property("restarts_s", restarts_s)
    assert server.poll() is None


@LONG
def test_a_paused_worker_cannot_end_the_job_that_another_took_over(site: Site, telemetry: bytes):
    """F2: with a lease of 2 s the first worker sleeps through it, wakes, and its result is rolled back."""
    short = {"MAGCAL_JOB_LEASE_S": "2", "MAGCAL_JOB_HEARTBEAT_S": "0.5"}
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        for _ in range(TRIALS):
            first = site.worker(FAULT_CALCULATION="slow", PLANTED_S="1", **short)
            job_id = submit(api, session_id)
            wait_for(api, job_id, "running")
            first.send_signal(signal.SIGSTOP)
            second = site.worker(**short)
            job = wait_for(api, job_id, "succeeded", "failed")
            assert (job["state"], job["attempts"]) == ("succeeded", 2)
            first.send_signal(signal.SIGCONT)
            deadline = time.monotonic() + 20.0
            while not any(one.get("event") == "job_ended" for one in site.log(first)):
                assert time.monotonic() < deadline, site.raw_log(first)
                time.sleep(0.1)
            ends = [one["state"] for one in site.log(first) if one.get("event") == "job_ended"]
            assert ends == ["lost"]
            assert api.get(f"/jobs/{job_id}").json() == job
            assert len(results(api, job_id)) == 1
            for worker in (first, second):
                worker.terminate()
                assert worker.wait(60) == 0


@LONG
def test_a_server_killed_in_the_middle_of_an_upload_has_kept_nothing(site: Site, telemetry: bytes):
    """F3: half of a body, then the kill; after the restart there is no session, and the retry makes one."""
    server, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
    chance = random.Random(SEED)  # noqa: S311
    for _ in range(TRIALS):
        port = int(url.rpartition(":")[2])
        head = (
            "POST /api/v1/satellites/a/sessions?magnetometer=m HTTP/1.1\r\nHost: a\r\nContent-Type: text/csv\r\n"
            f"Authorization: Bearer {site.admin_key}\r\nContent-Length: {len(telemetry)}\r\n\r\n"
        ).encode()
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(head + telemetry[: chance.randrange(len(telemetry))])
            time.sleep(0.1)
            server.kill()
            server.wait()
        server, url = site.serve(workers=0)
        with site.client(url) as api:
            assert api.get("/sessions").json()["items"] == []
    assert list((site.folder / "data" / "incoming").iterdir()) == []
    with site.client(url) as api:
        assert upload(api, telemetry).status_code == 201


@LONG
@pytest.mark.parametrize("point", ["before_commit", "after_commit"])
def test_a_server_killed_about_its_commit_answers_each_retry_with_one_session(
    site: Site, telemetry: bytes, point: str, record_property
):
    """F4: four stations share the commit; before it nothing is kept, after it retries find it, by key and by bytes."""
    armed, kept_of_killed = site.folder / "armed", []
    faulty = {"FAULT_POINT": point, "FAULT_WHEN": str(armed)}
    server, url = site.serve(workers=0, **faulty)
    with site.client(url) as api:
        prepare(api)

    def send(number: int) -> httpx2.Response:
        with site.client(url) as station:
            return upload(station, piece(telemetry, number), **{"idempotency-key": f"pass-{number}"})

    def kept(numbers: range) -> list[int]:
        """Return the numbers of the sessions that there are, each as often as it is there."""
        sent = {hashlib.sha256(piece(telemetry, number)).hexdigest(): number for number in numbers}
        with site.client(url) as api:
            newest = api.get("/sessions", params={"limit": 3 * STATIONS}).json()["items"]
        return sorted(sent[one["sha256"]] for one in newest if one["sha256"] in sent)

    with ThreadPoolExecutor(STATIONS) as stations:
        for trial in range(TRIALS):
            numbers = range(STATIONS * trial, STATIONS * (trial + 1))
            armed.touch()
            cut = [stations.submit(send, number) for number in numbers]
            assert all(isinstance(one.exception(), httpx2.TransportError) for one in cut)
            assert server.wait(30) == -signal.SIGKILL
            armed.unlink()
            server, url = site.serve(workers=0, **faulty)
            found = kept(numbers)
            assert (len(found) > 0) == (point == "after_commit")
            retried = list(stations.map(send, numbers))
            assert [one.status_code for one in retried] == [200 if number in found else 201 for number in numbers]
            with site.client(url) as api:
                again = [upload(api, piece(telemetry, number)).json()["id"] for number in numbers]
            assert again == [one.json()["id"] for one in retried]
            assert kept(numbers) == list(numbers)
            kept_of_killed.append(len(found))
    record_property("kept_of_killed", kept_of_killed)
    assert site.magcal("db", "audit") == 0


@LONG
def test_ten_stations_and_two_servers_make_one_session_and_one_job(site: Site, telemetry: bytes):
    """F10: the same pass at once through two server processes; the policy queues one job."""
    urls = [site.serve(workers=0)[1], site.serve(workers=0)[1]]
    with site.client(urls[0]) as api:
        prepare(api)
        api.post("/satellites/a/magnetometers", json={"id": "w", "unit": "nT", "policy": {}}).raise_for_status()
        rounds = [piece(telemetry, number) for number in range(5 * TRIALS)]

        def send(number: int, content: bytes) -> tuple[int, str]:
            with site.client(urls[number % 2]) as station:
                answer = station.post(
                    "/satellites/a/sessions", params={"magnetometer": "w"}, content=content, headers=CSV
                )
                return answer.status_code, answer.json()["id"]

        with ThreadPoolExecutor(10) as stations:
            for content in rounds:
                answers = list(stations.map(send, range(10), [content] * 10))
                assert sorted(status for status, _ in answers) == [200] * 9 + [201], answers
                assert len({session_id for _, session_id in answers}) == 1
        assert len(api.get("/sessions", params=ALL).json()["items"]) == len(rounds)
        assert len(api.get("/jobs", params=ALL).json()["items"]) == len(rounds)
