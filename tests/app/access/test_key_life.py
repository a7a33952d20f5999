"""The life of a key in two real server processes over one database, and no trace of its secret (A5, A6, A13)."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest

CSV = {"content-type": "text/csv"}
KEY = re.compile(r"mgc_[0-9a-f]{16}_[A-Za-z0-9_-]{43}")
START_S = 60.0
ROWS = "time,bx,by,bz,ref_b\n" + "".join(
    f"2026-01-01T00:00:{i:02d}Z,20000,-10000,{30000 + i},45000\n" for i in range(30)
)


@dataclass
class Process:
    """One `magcal serve` and what it writes."""

    process: subprocess.Popen[bytes]
    log: Path
    out: Path
    url: str = ""

    def client(self, key: str) -> httpx2.Client:
        headers = {"authorization": f"Bearer {key}"}
        return httpx2.Client(base_url=f"{self.url}/api/v1", headers=headers, timeout=30, trust_env=False)


def serve(folder: Path, number: int) -> Process:
    log, out = folder / f"log-{number}", folder / f"out-{number}"
    settings = {"MAGCAL_DATA_DIR": str(folder / "data"), "MAGCAL_WORKERS": "0", "MAGCAL_MIN_FREE_MB": "0"}
    command = [sys.executable, "-c", "from app.cli.main import run; run()", "serve", "--port", "0"]
    with log.open("wb") as stderr, out.open("wb") as stdout:
        process = subprocess.Popen(command, env={**os.environ, **settings}, stdout=stdout, stderr=stderr)
    one = Process(process, log, out)
    deadline = time.monotonic() + START_S
    while not one.url:
        assert time.monotonic() < deadline, log.read_text()
        assert process.poll() is None, log.read_text()
        for line in log.read_text().splitlines():
            if '"listening"' in line:
                one.url = json.loads(line)["url"]
        time.sleep(0.05)
    while True:
        try:
            httpx2.get(f"{one.url}/healthz", trust_env=False)
        except httpx2.TransportError:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        else:
            return one


@pytest.fixture(scope="module")
def servers(tmp_path_factory) -> Iterator[list[Process]]:
    """Two servers; the second finds the database of the first."""
    folder = tmp_path_factory.mktemp("servers")
    running = [serve(folder, 0)]
    running.append(serve(folder, 1))
    yield running
    for one in running:
        if one.process.poll() is None:
            one.process.send_signal(signal.SIGTERM)
    assert {one.process.wait(30) for one in running} <= {0, -signal.SIGTERM}


@pytest.fixture(scope="module")
def admin_key(servers) -> str:
    found = KEY.findall(servers[0].out.read_text())
    assert len(found) == 1
    assert KEY.findall(servers[1].out.read_text()) == []
    return found[0]


@pytest.fixture(scope="module")
def admin(servers, admin_key) -> Iterator[httpx2.Client]:
    with servers[0].client(admin_key) as client:
        client.post("/satellites", json={"id": "one"}).raise_for_status()
        client.post("/satellites/one/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        yield client


def new_key(admin: httpx2.Client, **body: object) -> dict:
    return admin.post("/keys", json={"scopes": ["read", "ingest", "operate"], **body}).raise_for_status().json()


def test_a_key_revoked_in_one_process_is_refused_by_the_other_within_a_second(servers, admin):
    made = new_key(admin)
    with servers[1].client(made["key"]) as elsewhere:
        assert elsewhere.get("/satellites").status_code == 200
        admin.post(f"/keys/{made['id']}/revoke").raise_for_status()
        revoked = time.monotonic()
        while elsewhere.get("/satellites").status_code != 401:
            assert time.monotonic() - revoked < 1.0
    assert time.monotonic() - revoked < 1.0


def test_an_upload_that_runs_when_its_key_is_revoked_ends_with_401_and_leaves_nothing(servers, admin):
    made = new_key(admin)
    body = ROWS.encode()
    connection = http.client.HTTPConnection(urlsplit(servers[1].url).netloc, timeout=30)
    connection.putrequest("POST", "/api/v1/satellites/one/sessions?magnetometer=mgm")
    for name, value in {"Authorization": f"Bearer {made['key']}", "Content-Length": str(len(body)), **CSV}.items():
        connection.putheader(name, value)
    connection.endheaders(body[:100])
    time.sleep(1.0)
    admin.post(f"/keys/{made['id']}/revoke").raise_for_status()
    connection.send(body[100:])
    answer = connection.getresponse()
    assert (answer.status, json.loads(answer.read())["code"]) == (401, "unauthorized")
    connection.close()
    assert admin.get("/sessions").json()["items"] == []


def test_a_job_goes_on_when_its_key_is_revoked_and_its_stream_of_events_ends(servers, admin):
    made = new_key(admin)
    with servers[1].client(made["key"]) as holder:
        query = {"magnetometer": "mgm"}
        sent = holder.post("/satellites/one/sessions", params=query, content=ROWS.encode(), headers=CSV).json()
        job = holder.post("/jobs", json={"kind": "calibration", "session_ids": [sent["id"]]}).json()
        with holder.stream("GET", f"/jobs/{job['id']}/events") as events:
            lines = events.iter_lines()
            assert next(lines) == "event: queued"
            admin.post(f"/keys/{made['id']}/revoke").raise_for_status()
            revoked = time.monotonic()
            assert not any(line.startswith("event:") for line in lines)
            assert time.monotonic() - revoked < 3.0
    assert admin.get(f"/jobs/{job['id']}").json()["state"] == "queued"


def test_a_key_ends_at_its_time(servers, admin):
    moment = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() + 2))
    made = new_key(admin, expires_at=moment)
    with servers[1].client(made["key"]) as client:
        assert client.get("/satellites").status_code == 200
        time.sleep(2.1)
        assert client.get("/satellites").status_code == 401


def test_a_revoked_key_stays_in_the_record_and_the_trail_says_who_did_it_when_and_from_where(admin, admin_key):
    made = new_key(admin, name="for the record")
    admin.post(f"/keys/{made['id']}/revoke", headers={"x-request-id": "trail-1"}).raise_for_status()
    kept = next(one for one in admin.get("/keys").json()["items"] if one["id"] == made["id"])
    assert kept["revoked_at"] is not None
    trail = [one for one in admin.get("/audit").json()["items"] if one["subject"] == made["id"]]
    assert [one["action"] for one in trail] == ["key.revoke", "key.create"]
    assert trail[0]["key_id"] == admin_key.split("_")[1]
    assert (trail[0]["address"], trail[0]["request_id"]) == ("127.0.0.1", "trail-1")
    assert trail[0]["at"].endswith("Z")


def test_no_secret_stands_in_a_log_or_in_the_database(servers, admin, admin_key):
    """Keys are sent where they belong and where they do not: path, query, body, request id, user agent, cookie."""
    made = new_key(admin)["key"]
    with servers[0].client(made) as client:
        client.get(f"/satellites/{made}")
        client.get("/satellites", params={"key": made})
        client.post("/satellites", json={"id": made})
        client.get("/satellites", headers={"x-request-id": made, "user-agent": made, "cookie": f"magcal_login={made}"})
        client.get("/satellites", headers={"authorization": f"Bearer {made}x"})
        client.post(f"{servers[0].url}/login", data={"key": f"{made}x"}, headers={"origin": servers[0].url})
        signed = client.post(f"{servers[0].url}/login", data={"key": made}, headers={"origin": servers[0].url})
    cookie = signed.cookies["magcal_login"]
    secrets = [made.split("_", 2)[2][:30], admin_key.split("_", 2)[2][:30], cookie[:30]]
    folder = servers[0].log.parent
    written = [servers[0].log, servers[1].log, *(path for path in (folder / "data").rglob("*") if path.is_file())]
    assert len(written) > 2
    found = [
        (path.name, number)
        for path in written
        for number, one in enumerate(secrets)
        if one.encode() in path.read_bytes()
    ]
    assert found == []
    assert f"mgc_{made.split('_')[1]}_..." in servers[0].log.read_text()


def test_every_line_of_the_log_is_json_with_the_id_of_its_request(servers, admin):
    answer = admin.get("/satellites", headers={"x-request-id": "look-for-me"})
    assert answer.headers["x-request-id"] == "look-for-me"
    deadline = time.monotonic() + 10
    while "look-for-me" not in servers[0].log.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    lines = [json.loads(line) for line in servers[0].log.read_text().splitlines()]
    mine = [line for line in lines if line.get("request_id") == "look-for-me"]
    assert [line["event"] for line in mine] == ["request"]
    assert admin.get("/satellites", headers={"x-request-id": "forged\tid"}).headers["x-request-id"] != "forged\tid"
