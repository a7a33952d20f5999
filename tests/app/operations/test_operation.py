"""Stores outside the database, retention, and the reprocessing of a history."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import httpx2
import pytest

from app.errors import StorageFullError, StoredObjectCorruptError, UnavailableError
from app.maintenance.audit import audit
from app.maintenance.rebuild import rebuild
from app.maintenance.retention import expired, remove_expired
from app.storage.object_store import BucketStore, FileStore
from app.storage.open_store import open_url
from app.storage.store import digest
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

CSV = {"content-type": "text/csv"}


@pytest.fixture(scope="module")
def telemetry() -> bytes:
    return write_samples(simulated(SESSIONS[0], samples=200).samples, "csv")


def fill(api, telemetry: bytes, satellite: str = "a", sessions: int = 2) -> list[str]:
    """Register a satellite with its orbit and some sessions; return the sessions' ids."""
    api.post("/satellites", json={"id": satellite}).raise_for_status()
    api.post(f"/satellites/{satellite}/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    lines = telemetry.splitlines(keepends=True)
    path, query = f"/satellites/{satellite}/sessions", {"magnetometer": "m"}
    contents = [b"".join(lines[: len(lines) - number]) for number in range(sessions)]
    return [api.post(path, params=query, content=one, headers=CSV).json()["id"] for one in contents]


def ended(api, job_id: str, timeout_s: float = 120.0) -> dict:
    deadline = time.monotonic() + timeout_s
    while (job := api.get(f"/jobs/{job_id}").json())["state"] in {"queued", "running"}:
        assert time.monotonic() < deadline, job
        time.sleep(0.05)
    return job


@pytest.fixture(scope="module")
def s3_server(tmp_path_factory) -> Iterator[str]:
    """An S3-compatible server as a process of its own, with the bucket ``kept``: its address."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    log = tmp_path_factory.mktemp("s3") / "log"
    with log.open("wb") as lines:
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
        server = subprocess.Popen(command, stdout=lines, stderr=lines)
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 60
        while not _has_bucket(url):
            assert server.poll() is None, log.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.1)
        yield url
    finally:
        server.terminate()
        server.wait(20)


def _has_bucket(url: str) -> bool:
    try:
        return httpx2.put(f"{url}/kept", trust_env=False).status_code == 200
    except httpx2.TransportError:
        return False


def use_bucket(monkeypatch, url: str) -> None:
    """Let obstore find the bucket's server and a key for it, as an operator does: in the environment."""
    for name, value in {
        "AWS_ENDPOINT_URL": url,
        "AWS_ALLOW_HTTP": "true",
        "AWS_REGION": "eu-central-1",
        "AWS_ACCESS_KEY_ID": "AKIAMAGCAL",
        "AWS_SECRET_ACCESS_KEY": "not-a-secret",
    }.items():
        monkeypatch.setenv(name, value)


@pytest.fixture(params=["database", "file", "memory", "s3"])
def service(request, new_service, tmp_path, monkeypatch):
    urls = {
        "database": None,
        "file": f"file://{tmp_path}/store",
        "memory": "memory:///",
        "s3": f"s3://kept/{tmp_path.name}",
    }
    if request.param == "s3":
        use_bucket(monkeypatch, request.getfixturevalue("s3_server"))
    return new_service(store_url=urls[request.param], workers=1)


@pytest.fixture
def store(service):
    return service.services.store


def test_an_audit_finds_every_acknowledged_byte_and_no_more(service, store, telemetry):
    with service.client() as api:
        session_ids = fill(api, telemetry)
        job = api.post("/jobs", json={"kind": "calibration", "session_ids": session_ids[:1]}).json()
        assert ended(api, job["id"])["state"] == "succeeded"
    done = audit(service.database, store)
    assert (done.findings, done.sessions, done.parameter_sets, done.objects) == ((), 2, 1, 6)
    with service.database.write() as session:
        store.put(session, "raw/a/stray", b"stray")
        store.delete(session, f"columns/{session_ids[1]}/0")
    findings = {(one.code, one.subject) for one in audit(service.database, store).findings}
    assert findings == {
        ("unnamed_object", "raw/a/stray"),
        ("stored_object_corrupt", f"columns/{session_ids[1]}/0"),
    }


def test_derived_chunks_are_made_again_from_the_raw_bytes(service, store, telemetry):
    with service.client() as api:
        first, _second = fill(api, telemetry)
        before = api.get(f"/sessions/{first}/samples").content
        with service.database.write() as session:
            store.delete(session, f"columns/{first}/0")
        assert api.get(f"/sessions/{first}/samples").json()["code"] == "stored_object_corrupt"
        done = rebuild(service.database, store, service.settings)
        assert (done.chunks, done.changed, done.without_bytes) == (2, 1, 0)
        assert api.get(f"/sessions/{first}/samples").content == before
    assert audit(service.database, store).findings == ()


def test_retention_removes_bytes_but_no_record_and_says_so_first(service, store, telemetry):
    with service.client() as api:
        old = fill(api, telemetry, sessions=1)[0]
        now = datetime.now(UTC).replace(microsecond=0)
        rows = [f"{(now - timedelta(seconds=i)).isoformat()},20000,{i},30000,36000" for i in range(20)]
        fresh_csv = "\n".join(["time,bx,by,bz,ref_b", *rows, ""])
        path = "/satellites/a/sessions"
        fresh = api.post(path, params={"magnetometer": "m"}, content=fresh_csv, headers=CSV).json()["id"]
        assert expired(service.database) == []
        assert api.patch("/satellites/a", json={"retention_days": 30}).json()["retention_days"] == 30
        assert [one.session_id for one in expired(service.database)] == [old]
        assert api.get(f"/sessions/{old}/samples").status_code == 200
        assert [one.session_id for one in remove_expired(service.database, store)] == [old]
        gone = api.get(f"/sessions/{old}/samples")
        assert (gone.status_code, gone.json()["code"]) == (410, "expired")
        assert api.get(f"/sessions/{old}").json()["raw_removed_at"] is not None
        assert api.get(f"/sessions/{fresh}/samples").status_code == 200
        assert api.post("/jobs", json={"kind": "calibration", "session_ids": [old]}).status_code == 410
    assert audit(service.database, store).findings == ()


def test_a_history_is_reprocessed_by_one_request_with_its_own_progress(new_service, telemetry):
    service = new_service(workers=1)
    with service.client() as api:
        fill(api, telemetry, "a", 3)
        fill(api, telemetry, "b", 2)
        asked = api.post("/reprocessings", json={"satellites": ["a", "b"], "method": "vector"})
        assert asked.status_code == 202
        job = ended(api, asked.json()["id"])
        assert (job["kind"], job["state"], job["progress"]) == ("reprocessing", "succeeded", 1.0)
        assert job["result"] == {"succeeded": 5, "failed": 0, "cancelled": 0}
        children = api.get("/jobs", params={"parent": job["id"]}).json()["items"]
        assert {(one["kind"], one["satellite"], one["options"]["method"]) for one in children} == {
            ("calibration", "a", "vector"),
            ("calibration", "b", "vector"),
        }
        assert api.post("/reprocessings", json={"satellites": ["nowhere"]}).status_code == 404
        assert api.post("/reprocessings", json={"since": "2100-01-01T00:00:00Z"}).status_code == 409


def test_a_cancelled_reprocessing_cancels_what_waits(new_service, telemetry):
    service = new_service(workers=0)
    with service.client() as api:
        fill(api, telemetry, "a", 3)
        job_id = api.post("/reprocessings", json={}).json()["id"]
        assert api.get(f"/jobs/{job_id}").json()["progress"] == 0.0
        assert api.post(f"/jobs/{job_id}/cancel").json()["state"] == "cancelled"
        states = {one["state"] for one in api.get("/jobs", params={"parent": job_id}).json()["items"]}
        assert states == {"cancelled"}


def test_a_folder_store_that_failed_once_takes_no_more(tmp_path, monkeypatch):
    """F7: an fsync that fails is never taken for one that worked, and the store is out of order from then on."""
    folder = FileStore(tmp_path)
    folder.put(None, "raw/a/1", b"kept")

    def fail(_number: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("app.storage.object_store.os.fsync", fail)
    with pytest.raises(UnavailableError):
        folder.put(None, "raw/a/2", b"lost")
    monkeypatch.undo()
    with pytest.raises(UnavailableError):
        folder.put(None, "raw/a/2", b"lost")
    with pytest.raises(UnavailableError):
        folder.check()
    assert folder.get(None, "raw/a/1", digest(b"kept")) == b"kept"
    assert list(folder.keys(None)) == ["raw/a/1"]


def test_a_folder_store_without_room_says_so_and_recovers(tmp_path, monkeypatch):
    folder = FileStore(tmp_path)

    def full(_number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("app.storage.object_store.os.fsync", full)
    with pytest.raises(StorageFullError):
        folder.put(None, "raw/a/1", b"x")
    monkeypatch.undo()
    folder.put(None, "raw/a/1", b"x")


def test_a_bucket_holds_what_is_asked_for_under_its_prefix_and_says_when_it_is_away(s3_server, monkeypatch):
    """Against a server that speaks S3's protocol over HTTP; 30 MB go in parts."""
    use_bucket(monkeypatch, s3_server)
    bucket = open_url("s3://kept/under/here")
    large = bytes(range(256)) * 120_000
    assert bucket.put(None, "raw/a/large", large) == digest(large)
    assert bucket.get(None, "raw/a/large", digest(large)) == large
    assert list(bucket.keys(None)) == ["raw/a/large"]
    listing = httpx2.get(f"{s3_server}/kept?list-type=2&prefix=under/", trust_env=False).text
    assert "<Key>under/here/raw/a/large</Key>" in listing
    with pytest.raises(StoredObjectCorruptError):
        bucket.get(None, "raw/a/large", digest(b"another"))
    bucket.delete(None, "raw/a/large")
    bucket.delete(None, "raw/a/large")
    with pytest.raises(StoredObjectCorruptError):
        bucket.get(None, "raw/a/large", digest(large))
    with pytest.raises(UnavailableError):
        open_url("s3://not-there/x").check()
    with pytest.raises(UnavailableError):
        open_url("s3://not-there/x").put(None, "raw/a/1", b"x")


def test_the_url_tells_the_store(tmp_path):
    assert isinstance(open_url(f"file://{tmp_path}/x"), FileStore)
    assert isinstance(open_url("memory:///"), BucketStore)
