"""Calculations that take too long, too much or their process with them: only the child dies, the queue moves on."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from faultsite import Site, prepare, submit, upload, wait_for

MEMORY = {"MAGCAL_JOB_MEMORY_MB": "3072"}
TIME = {"MAGCAL_JOB_TIMEOUT_S": "4"}


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("calculation", "code", "attempts"),
    [("hang", "timed_out", 1), ("hoard", "job_memory", 1), ("crash", "dead", 3), ("stumble", "internal", 1)],
)
def test_a_calculation_that_goes_wrong_ends_its_job_and_no_other(
    new_site: Callable[..., Site], telemetry: bytes, calculation: str, code: str, attempts: int
):
    """F18, F19, F20: the job fails with its reason, a deterministic failure is not tried again, a sound job follows."""
    site = new_site()
    server, url = site.serve(workers=1, FAULT_CALCULATION=calculation, **(TIME if code == "timed_out" else MEMORY))
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        job = wait_for(api, submit(api, session_id), "failed", timeout_s=180)
        assert (job["error"]["code"], job["attempts"], job["result"]) == (code, attempts, None)
    assert server.poll() is None
    server.terminate()
    assert server.wait(60) == 0
    _, url = site.serve(workers=1)
    with site.client(url) as api:
        wait_for(api, submit(api, session_id), "succeeded")


@pytest.mark.timeout(600)
def test_a_running_calculation_is_cancelled_within_two_seconds(new_site: Callable[..., Site], telemetry: bytes):
    site = new_site()
    _, url = site.serve(workers=1, FAULT_CALCULATION="hang")
    with site.client(url) as api:
        prepare(api)
        job_id = submit(api, upload(api, telemetry).json()["id"])
        wait_for(api, job_id, "running")
        time.sleep(1.0)
        begun = time.monotonic()
        assert api.post(f"/jobs/{job_id}/cancel").json()["cancel_requested"]
        wait_for(api, job_id, "cancelled")
        assert time.monotonic() - begun < 2.0 + 3.0


@pytest.mark.timeout(600)
def test_a_worker_that_is_asked_to_stop_hands_its_job_on(new_site: Callable[..., Site], telemetry: bytes):
    """F21: SIGTERM lets a short job end; nothing is lost and nothing runs twice."""
    site = new_site()
    _, url = site.serve(workers=0)
    worker = site.worker(FAULT_CALCULATION="slow", PLANTED_S="3")
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        first, second = submit(api, session_id), submit(api, session_id)
        wait_for(api, first, "running")
        worker.terminate()
        job = wait_for(api, first, "succeeded", "failed")
        assert (job["state"], job["attempts"]) == ("succeeded", 1)
        assert worker.wait(60) == 0
        assert api.get(f"/jobs/{second}").json()["state"] == "queued"
        site.worker()
        wait_for(api, second, "succeeded")


@pytest.mark.timeout(600)
def test_a_full_database_is_told_and_reading_goes_on(new_site: Callable[..., Site], telemetry: bytes):
    """F6: SQLite may grow no further; uploads answer 507, what is there can be read, and more room mends it."""
    site = new_site()
    server, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
        kept = upload(api, telemetry).json()
    server.terminate()
    server.wait()
    pages = (site.folder / "data" / "magcal.db").stat().st_size // 4096 + 8
    server, url = site.serve(workers=0, FAULT_PAGES=str(pages))
    larger = telemetry * 1 + b"".join(telemetry.splitlines(keepends=True)[1:]).replace(b"2022-02", b"2022-03")
    with site.client(url) as api:
        refused = upload(api, larger)
        assert (refused.status_code, refused.json()["code"]) == (507, "storage_full")
        assert api.get(f"/sessions/{kept['id']}").json()["sha256"] == kept["sha256"]
        assert len(api.get("/sessions").json()["items"]) == 1
    server.terminate()
    server.wait()
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        assert upload(api, larger).status_code == 201
    _, url = site.serve(workers=0, MAGCAL_MIN_FREE_MB=str(1 << 40))
    with site.client(url) as api:
        refused = upload(api, telemetry.replace(b"2022-02", b"2022-04"))
        assert (refused.status_code, refused.json()["code"]) == (507, "storage_full")
