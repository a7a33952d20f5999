"""A station between bad proxies, bad files and bad disks: each pass reaches the service, none is put aside early."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx2
import pytest

from app.cli.push import shown
from app.client.folder import put_aside
from app.client.requests import pause_s
from app.maintenance.audit import audit

WAIT_S = 60.0
ENTRY = [sys.executable, "-c", "from app.cli.main import run; run()"]
Answer = Callable[[BaseHTTPRequestHandler, bytes], bool]
"""Answers a request in the service's place, or returns False: then the service does."""


def telemetry(number: int) -> str:
    rows = [f"2026-01-01T{number // 60:02d}:{number % 60:02d}:{s:02d}Z,{20000 + number},{s},2,20000" for s in range(20)]
    return "\n".join(["time,bx,by,bz,ref_b", *rows]) + "\n"


def words(folder: Path, satellite: str, *options: str) -> list[str]:
    given = ["--satellite", satellite, "--magnetometer", "mgm", "--settle", "0.2", "--poll", "0.1", *options]
    return [*ENTRY, "push", str(folder), *given]


def push(folder: Path, satellite: str, url: str, key: str, *options: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"MAGCAL_URL": url, "MAGCAL_KEY": key}
    return subprocess.run(
        words(folder, satellite, *options), env=environment, capture_output=True, text=True, check=False, timeout=WAIT_S
    )


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.is_file() and path.suffix == ".csv")


@contextmanager
def between(service_url: str, answer: Answer) -> Iterator[str]:
    """Yield the address of a proxy that lets ``answer`` speak first."""

    class Proxy(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length", "0")))
            if answer(self, body):
                return
            headers = {name: value for name, value in self.headers.items() if name.lower() != "host"}
            found = httpx2.post(f"{service_url}{self.path}", content=body, headers=headers, trust_env=False, timeout=60)
            say(self, found.status_code, found.headers["content-type"], found.content)

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Proxy)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


def say(to: BaseHTTPRequestHandler, status: int, kind: str, body: bytes, **headers: str) -> bool:
    to.send_response(status)
    for name, value in ({"content-type": kind, "content-length": str(len(body))} | headers).items():
        to.send_header(name.replace("_", "-"), value)
    to.end_headers()
    to.wfile.write(body)
    return True


def problem(status: int, code: str) -> bytes:
    return json.dumps(
        {"type": f"urn:magcal:problem:{code}", "title": "x", "status": status, "detail": "d", "code": code}
    ).encode()


OURS = "application/problem+json"
HTML = b"<html><body>Request Entity Too Large</body></html>"
WEATHER: dict[str, tuple[int, str, bytes]] = {
    "400 in HTML": (400, "text/html", HTML),
    "413 in HTML": (413, "text/html", HTML),
    "422 in HTML": (422, "text/html", HTML),
    "413 in a stranger's JSON": (413, "application/json", b'{"error": "too large"}'),
    "422 in JSON like ours": (422, "application/json", problem(422, "telemetry_format")),
    "a flipped bit": (400, OURS, problem(400, "digest_mismatch")),
    "a truncated body": (400, OURS, problem(400, "upload_truncated")),
    "a login page": (200, "text/html", b"<html>please sign in</html>"),
    "a 200 that is not ours": (200, "application/json", b'{"id": "0", "sha256": "0"}'),
    "a list": (201, "application/json", b"[1, 2]"),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "passes"
    place.mkdir()
    return place


@pytest.mark.parametrize("weather", WEATHER)
def test_what_a_proxy_says_puts_no_pass_aside_and_holds_up_no_other(service, api, satellite, folder, weather):
    """The oldest of two passes meets it; the other is sent meanwhile, and the first in the next round."""
    for number in range(2):
        (folder / f"pass-{number}.csv").write_text(telemetry(number))
        os.utime(folder / f"pass-{number}.csv", (1000 + number, 1000 + number))
    key, bad = service.key("ingest"), telemetry(0).encode()
    with between(service.url, lambda to, body: say(to, *WEATHER[weather]) if body == bad else False) as url:
        done = push(folder, satellite, url, key)
    assert done.returncode == 1
    assert "pass-0.csv: kept" in done.stderr
    assert names(folder) == ["pass-0.csv"]
    assert names(folder / "sent") == ["pass-1.csv"]
    assert names(folder / "refused") == []
    assert push(folder, satellite, service.url, key).returncode == 0
    assert len(api.get("/sessions", params={"satellite": satellite}).json()["items"]) == 2


@pytest.mark.parametrize("after", ["86400", "9" * 20, "soon", "²", "-1", "1e3"])
def test_no_retry_after_makes_a_client_deaf(after):
    answer = httpx2.Response(503, headers=[(b"retry-after", after.encode("latin-1"))])
    assert 0 < pause_s(1, answer) <= 30


@pytest.mark.parametrize("how", ["slow", "retry-after"])
def test_a_station_that_waits_for_an_answer_hears_sigterm(service, satellite, folder, how):
    (folder / "pass.csv").write_text(telemetry(0))
    is_asked, is_over = threading.Event(), threading.Event()

    def hold(to: BaseHTTPRequestHandler, _body: bytes) -> bool:
        is_asked.set()
        if how == "retry-after":
            return say(to, 503, OURS, problem(503, "busy"), retry_after="86400")
        is_over.wait(WAIT_S)
        return say(to, 503, "text/plain", b"late")

    with between(service.url, hold) as url:
        environment = os.environ | {"MAGCAL_URL": url, "MAGCAL_KEY": "mgc_key"}
        process = subprocess.Popen(words(folder, satellite, "--watch"), env=environment, stderr=subprocess.PIPE)
        assert is_asked.wait(WAIT_S)
        begun = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
        assert time.monotonic() - begun < 5
        process.stderr.close()
        is_over.set()
    assert names(folder) == ["pass.csv"]


def test_links_are_followed_only_where_that_is_asked_for(service, api, satellite, folder, tmp_path):
    (tmp_path / "elsewhere.csv").write_text(telemetry(0))
    (folder / "link.csv").symlink_to(tmp_path / "elsewhere.csv")
    key = service.key("ingest")
    assert push(folder, satellite, service.url, key).returncode == 0
    assert api.get("/sessions", params={"satellite": satellite}).json()["items"] == []
    assert push(folder, satellite, service.url, key, "--follow-links").returncode == 0
    assert len(api.get("/sessions", params={"satellite": satellite}).json()["items"]) == 1


def test_names_of_252_bytes_and_names_that_a_terminal_would_obey(service, api, satellite, folder):
    long = "n" * 248 + ".csv"
    (folder / long).write_text("time,bx,by,bz\nyesterday,1,2,3\n")
    (folder / "red\x1b[31m\n.csv").write_text(telemetry(0))
    (folder / os.fsdecode(b"latin-\xe9.csv")).write_text(telemetry(1))
    done = push(folder, satellite, service.url, service.key("ingest"))
    assert names(folder) == []
    assert names(folder / "refused") == [long]
    assert len(api.get("/sessions", params={"satellite": satellite}).json()["items"]) == 2
    assert "\x1b" not in done.stdout + done.stderr
    assert r"red\x1b[31m\n.csv: session" in done.stdout
    assert [path.name for path in (folder / "refused").glob("*.why")] != []


def test_what_is_shown_is_what_a_terminal_can_show():
    assert shown("pass é.csv: session 1") == "pass é.csv: session 1"
    assert shown("a\rb\x9b2Jc\u202e\udce9") == r"a\rb\x9b2Jc\u202e\udce9"


def test_a_file_is_carried_to_another_disk_whole(tmp_path, monkeypatch):
    other = Path("/dev/shm")  # noqa: S108  the other disk, where there is one
    if not other.is_dir() or other.stat().st_dev == tmp_path.stat().st_dev:
        other = None
    source = tmp_path / "pass.csv"
    source.write_text(telemetry(0))
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    place = tmp_path / "sent" if other is None else other / f"magcal-{os.getpid()}"
    place.mkdir()
    if other is None:
        monkeypatch.setattr(Path, "rename", lambda *_: (_ for _ in ()).throw(OSError(18, "another disk")))
    try:
        target = put_aside(source, place, digest)
        assert target.read_text() == telemetry(0)
        assert not source.exists()
        assert [path.name for path in place.iterdir()] == ["pass.csv"]
    finally:
        shutil.rmtree(place)


def test_after_a_restore_of_the_server_one_push_sends_what_is_missing(new_service, folder, tmp_path):
    """Two passes, a backup, two more, and the server of the backup: the receipts say four, the server has two."""
    first = new_service()
    key = first.key("ingest", "read")
    with first.client() as admin:
        admin.post("/satellites", json={"id": "a"}).raise_for_status()
        admin.post("/satellites/a/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    for number in range(2):
        (folder / f"pass-{number}.csv").write_text(telemetry(number))
    assert push(folder, "a", first.url, key).returncode == 0
    backup = tmp_path / "backup"
    backup.mkdir()
    with closing(sqlite3.connect(first.settings.data_dir / "magcal.db")) as database:
        database.execute("VACUUM INTO ?", (str(backup / "magcal.db"),))
    shutil.copy(first.settings.data_dir / "magcal-database.json", backup)
    for number in range(2, 4):
        (folder / f"pass-{number}.csv").write_text(telemetry(number))
    assert push(folder, "a", first.url, key).returncode == 0
    restored = new_service(data_dir=backup)
    done = push(folder, "a", restored.url, key)
    assert done.returncode == 0
    assert sorted(line.partition(":")[0] for line in done.stdout.splitlines()) == ["pass-2.csv", "pass-3.csv"]
    with restored.client(key) as api:
        assert len(api.get("/sessions").json()["items"]) == 4
    receipts = [json.loads(line) for line in (folder / "sent" / "receipts.ndjson").read_text().splitlines()]
    assert {one["database"] for one in receipts} == {restored.services.database_id}
    store = restored.services.store
    assert audit(restored.database, store, [folder / "sent" / "receipts.ndjson"]).findings == ()
    assert push(folder, "a", restored.url, key).stdout == ""


def test_the_audit_finds_what_a_receipt_has_and_the_server_has_not(new_service, tmp_path):
    service = new_service()
    receipt = {"name": "p.csv", "sha256": "0" * 64, "session_id": "1", "satellite": "a", "magnetometer": "m"}
    (tmp_path / "receipts.ndjson").write_text(json.dumps(receipt) + "\n")
    found = audit(service.database, service.services.store, [tmp_path / "receipts.ndjson"]).findings
    assert [one.code for one in found] == ["receipt"]


def test_a_server_that_answers_nothing_at_all_ends_no_watch(satellite, folder):
    """A port that takes connections and says nothing; SIGTERM ends the watch, and the pass is still there."""
    (folder / "pass.csv").write_text(telemetry(0))
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(WAIT_S)
        environment = os.environ | {
            "MAGCAL_URL": f"http://127.0.0.1:{silent.getsockname()[1]}",
            "MAGCAL_KEY": "mgc_key",
        }
        process = subprocess.Popen(words(folder, satellite, "--watch"), env=environment)
        connection, _ = silent.accept()
        with connection:
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
    assert names(folder) == ["pass.csv"]
