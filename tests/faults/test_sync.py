"""A disk whose fsync fails (F7): in the process itself, under SQLite and under the folder store."""

from __future__ import annotations

import hashlib
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import httpx2
import pytest
from faultsite import Site, piece, prepare, submit, upload, wait_for


@pytest.fixture(scope="session")
def failing_sync(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library whose syncs fail when they are asked to."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    assert compiler, "no C compiler is installed; `make system` installs one"
    library = tmp_path_factory.mktemp("sync") / "failing_sync.so"
    source = Path(__file__).with_name("failing_sync.c")
    subprocess.run([compiler, "-Wall", "-Werror", "-O2", "-shared", "-fPIC", "-o", library, source], check=True)
    return library


class Disk:
    """The disk of a site's processes, which can be broken below a path and mended."""

    def __init__(self, folder: Path, library: Path) -> None:
        self._control, self._log = folder / "broken", folder / "syncs"
        self.environment = {
            "LD_PRELOAD": str(library),
            "FAULT_SYNC": str(self._control),
            "FAULT_SYNC_LOG": str(self._log),
        }

    def break_below(self, path: Path) -> None:
        self._control.write_text(str(path))

    def mend(self) -> None:
        self._control.unlink()

    def syncs(self) -> list[tuple[str, str]]:
        """Return how each sync ended, and of what."""
        return [(line.partition(" ")[0], line.partition(" ")[2]) for line in self._log.read_text().splitlines()]


@pytest.fixture
def disk(tmp_path: Path, failing_sync: Path) -> Disk:
    return Disk(tmp_path, failing_sync)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("store", ["database", "folder"])
def test_nothing_is_acknowledged_after_a_failed_fsync(
    new_site: Callable[..., Site], tmp_path: Path, disk: Disk, telemetry: bytes, store: str
):
    """F7: 503 from the failure on, also once the disk works again; unready; reads go on; a restart has every byte."""
    site, data = new_site(), tmp_path / "data"
    if store == "folder":
        site.environment["MAGCAL_STORE_URL"] = f"file://{data}/store"
    server, url = site.serve(workers=0, **disk.environment)
    with site.client(url) as api:
        prepare(api)
        kept = [upload(api, piece(telemetry, number)) for number in range(3)]
        assert [one.status_code for one in kept] == [201] * 3
        assert httpx2.get(f"{url}/readyz", trust_env=False).status_code == 200
        disk.break_below(data / "store" if store == "folder" else data / "magcal.db")
        refused = [upload(api, piece(telemetry, 3 + number)) for number in range(5)]
        disk.mend()
        refused += [upload(api, piece(telemetry, 3 + number)) for number in range(5)]
        for one in refused:
            assert (one.status_code, one.json()["code"]) == (503, "unavailable")
            assert int(one.headers["retry-after"]) > 0
        ready = httpx2.get(f"{url}/readyz", trust_env=False)
        part = "store" if store == "folder" else "database"
        assert (ready.status_code, ready.json()[part]) == (503, "failing")
        for one in kept:
            found = api.get(f"/sessions/{one.json()['id']}/samples")
            assert found.status_code == 200
    failed = [path for outcome, path in disk.syncs() if outcome == "failed"]
    assert len(failed) == 1  # what failed once was not tried again
    after = disk.syncs()[disk.syncs().index(("failed", failed[0])) + 1 :]
    assert failed[0] not in [path for _, path in after]
    server.send_signal(signal.SIGKILL)
    server.wait()
    before = len(disk.syncs())
    _, url = site.serve(workers=0, **disk.environment)
    if store == "database":  # the write whose sync failed may have come back; then it must be durable by now
        assert ("ok", f"{data}/magcal.db") in disk.syncs()[before:]
    assert site.magcal("db", "audit") == 0
    with site.client(url) as api:
        sessions = {one["sha256"] for one in api.get("/sessions").json()["items"]}
        sent = [hashlib.sha256(piece(telemetry, number)).hexdigest() for number in range(4)]
        assert set(sent[:3]) <= sessions <= set(sent)
        assert upload(api, piece(telemetry, 3)).status_code == (200 if sent[3] in sessions else 201)
    assert httpx2.get(f"{url}/readyz", trust_env=False).status_code == 200


@pytest.mark.timeout(300)
def test_a_worker_whose_fsync_failed_takes_no_job_until_it_is_started_anew(
    new_site: Callable[..., Site], tmp_path: Path, disk: Disk, telemetry: bytes
):
    """F7: its claim or its result is not durable, so it is none; another worker makes the one result."""
    site = new_site()
    _, url = site.serve(workers=0)
    broken = site.worker(MAGCAL_JOB_LEASE_S="2", MAGCAL_JOB_HEARTBEAT_S="0.5", **disk.environment)
    with site.client(url) as api:
        prepare(api)
        session_id = upload(api, telemetry).json()["id"]
        disk.break_below(tmp_path / "data" / "magcal.db")
        job_id = submit(api, session_id)
        while not any(one.get("event") == "claim_failed" for one in site.log(broken)):
            assert broken.poll() is None
        disk.mend()
        site.worker()
        job = wait_for(api, job_id, "succeeded", "failed")
        assert job["state"] == "succeeded"
        assert f":{broken.pid}:" not in str(job["worker"])
        assert len(api.get("/parameter-sets").json()["items"]) == 1
