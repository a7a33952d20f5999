"""The machine's clock steps by an hour, forward and back, in the middle of jobs (F13)."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import libfaketime
import pytest
from faultsite import Site, prepare, submit, upload, wait_for

SLOW = {"FAULT_CALCULATION": "slow", "PLANTED_S": "6"}


class Clock:
    """The clock of a site's processes; intervals are the machine's own, as they are after a real step."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.step("+0")
        library = Path(libfaketime.__file__).parent / "vendor" / "libfaketime" / "src" / "libfaketime.so.1"
        self.environment = {
            "LD_PRELOAD": str(library),
            "FAKETIME_TIMESTAMP_FILE": str(file),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "DONT_FAKE_MONOTONIC": "1",
        }

    def step(self, by: str) -> None:
        self._file.write_text(f"{by}\n")


@pytest.fixture(scope="module")
def clocks(tmp_path_factory: pytest.TempPathFactory) -> Clock:
    return Clock(tmp_path_factory.mktemp("clock") / "clock")


@pytest.fixture
def clock(clocks: Clock) -> Clock:
    """The one clock of these tests, which goes right."""
    clocks.step("+0")
    return clocks


@pytest.fixture
def site(clock: Clock, new_site: Callable[..., Site]) -> Site:
    site = new_site()
    site.environment |= clock.environment
    return site


@pytest.mark.timeout(300)
def test_no_step_of_the_clock_takes_a_job_from_a_worker_that_lives(site: Site, clock: Clock, telemetry: bytes):
    """Another worker looks for lost jobs four times a second all the while."""
    _, url = site.serve(workers=0)
    site.worker(**SLOW)
    site.worker(**SLOW)
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        for step in ("+1h", "+0", "-1h", "+0"):
            job_id = submit(api, session_id)
            wait_for(api, job_id, "running")
            clock.step(step)
            job = wait_for(api, job_id, "succeeded", "failed")
            assert (job["state"], job["attempts"]) == ("succeeded", 1), (step, job["error"])
        jobs = api.get("/jobs").json()["items"]
        assert len(api.get("/parameter-sets").json()["items"]) == len(jobs) == 4


@pytest.mark.timeout(300)
def test_a_clock_that_steps_back_leaves_no_job_to_a_dead_worker(site: Site, clock: Clock, telemetry: bytes):
    """Its lease would run for an hour more by the clock; 14 s of real time are enough."""
    _, url = site.serve(workers=0)
    first = site.worker(**SLOW)
    with site.client(url) as api:
        prepare(api)
        job_id = submit(api, upload(api, telemetry).json()["id"])
        wait_for(api, job_id, "running")
        first.kill()
        clock.step("-1h")
        site.worker()
        job = wait_for(api, job_id, "succeeded", "failed", timeout_s=60)
        assert (job["state"], job["attempts"]) == ("succeeded", 2)


def test_a_clock_that_steps_back_revives_no_key(site: Site, clock: Clock):
    """An expired key, a revoked one, and a dashboard's login stay what they are."""
    _, url = site.serve(workers=0)
    with site.client(url) as api:
        soon = (datetime.now(UTC) + timedelta(seconds=3)).isoformat()
        expiring = api.post("/keys", json={"scopes": ["read"], "expires_at": soon}).json()
        revoked = api.post("/keys", json={"scopes": ["read"]}).json()
        api.post(f"/keys/{revoked['id']}/revoke").raise_for_status()
        time.sleep(3.5)
        for step in ("+0", "-1h", "+1h", "-1h"):
            clock.step(step)
            time.sleep(0.6)
            for key in (expiring, revoked):
                answer = api.get("/satellites", headers={"Authorization": f"Bearer {key['key']}"})
                assert answer.status_code == 401, step
        clock.step("+0")
