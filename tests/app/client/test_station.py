"""`magcal push` over a folder: real processes, killed and cut off; no file is lost and none becomes two sessions."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

WAIT_S = 60.0
LOOK = ("--settle", "0.3", "--poll", "0.1")


def telemetry(number: int) -> str:
    """Return a small pass that differs from every other."""
    rows = [f"2026-01-01T{number // 60:02d}:{number % 60:02d}:{s:02d}Z,{20000 + number},{s},2,20000" for s in range(20)]
    return "\n".join(["time,bx,by,bz,ref_b", *rows]) + "\n"


def command(folder: Path, satellite: str, *options: str) -> list[str]:
    entry = [sys.executable, "-c", "from app.cli.main import run; run()"]
    return [*entry, "push", str(folder), "--satellite", satellite, "--magnetometer", "mgm", *LOOK, *options]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "passes"
    place.mkdir()
    return place


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start `magcal push --watch` processes; what runs at the end is asked to stop once it watches, and has to."""
    running = []

    def start(folder: Path, satellite: str, url: str, key: str) -> subprocess.Popen[str]:
        environment = os.environ | {"MAGCAL_URL": url, "MAGCAL_KEY": key}
        process = subprocess.Popen(
            command(folder, satellite, "--watch"),
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        running.append(process)
        return process

    yield start
    asked = [process for process in running if process.poll() is None]
    for process in asked:
        until(lambda process=process: awaits_the_signal(process))
        process.terminate()
    for process in running:
        process.communicate(timeout=WAIT_S)
    assert {process.returncode for process in asked} <= {0}


def awaits_the_signal(process: subprocess.Popen[str]) -> bool:
    """Return whether a process catches SIGTERM, as the kernel says."""
    status = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def push(folder: Path, satellite: str, url: str, key: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"MAGCAL_URL": url, "MAGCAL_KEY": key}
    return subprocess.run(
        command(folder, satellite), env=environment, capture_output=True, text=True, check=False, timeout=WAIT_S
    )


def until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_S
    while not is_so():
        assert time.monotonic() < deadline, "it did not come to this"
        time.sleep(0.05)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.suffix == ".csv")


def receipts(folder: Path) -> list[dict[str, str]]:
    path = folder / "sent" / "receipts.ndjson"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def sessions(api, satellite: str) -> list[dict]:
    return api.get("/sessions", params={"satellite": satellite, "limit": 1000}).json()["items"]


def write_whole(path: Path, text: str) -> None:
    part = path.with_name(f"{path.name}.part")
    part.write_text(text)
    part.rename(path)


@contextmanager
def relay(service_url: str, *, answers: bool) -> Iterator[tuple[str, threading.Event]]:
    """Yield the address of a relay to the service, and an event for every request it passed on.

    Without ``answers`` the service's answer is held back until the caller goes away.
    """
    upstream = ("127.0.0.1", int(service_url.rpartition(":")[2]))
    passed, over = threading.Event(), threading.Event()

    def carry(connection: socket.socket) -> None:
        with connection, socket.create_connection(upstream, timeout=WAIT_S) as server:
            server.sendall(_whole_request(connection))
            answer = b"".join(iter(lambda: server.recv(1 << 16), b""))
            passed.set()
            if answers:
                connection.sendall(answer)
            else:
                over.wait(WAIT_S)

    def listen(listener: socket.socket) -> None:
        while not over.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            threads.append(threading.Thread(target=carry, args=(connection,)))
            threads[-1].start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(0.1)
        threads = [threading.Thread(target=listen, args=(listener,))]
        threads[0].start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", passed
        over.set()
        for thread in threads:
            thread.join()


def _whole_request(connection: socket.socket) -> bytes:
    request = connection.recv(1 << 16)
    while b"\r\n\r\n" not in request:
        request += connection.recv(1 << 16)
    head, _, body = request.partition(b"\r\n\r\n")
    length = next(int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
    while len(body) < length:
        body += connection.recv(1 << 16)
    return head.replace(b"keep-alive", b"close") + b"\r\n\r\n" + body


def test_files_that_arrive_are_sent_moved_and_receipted(service, api, satellite, folder, watch):
    write_whole(folder / "before.csv", telemetry(0))
    process = watch(folder, satellite, service.url, service.key("ingest", satellites=[satellite]))
    until(lambda: names(folder / "sent") == ["before.csv"] if (folder / "sent").exists() else False)
    write_whole(folder / "after.csv", telemetry(1))
    (folder / "unrelated.log").write_text("not telemetry")
    until(lambda: names(folder / "sent") == ["after.csv", "before.csv"])
    assert names(folder) == []
    assert (folder / "unrelated.log").exists()
    found = {one["session_id"] for one in receipts(folder)}
    assert found == {one["id"] for one in sessions(api, satellite)}
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=WAIT_S) == 0


def test_a_watcher_killed_at_any_time_loses_nothing_and_sends_nothing_twice(service, api, satellite, folder, watch):
    """Twelve passes, and a kill -9 after every third that is sent, wherever the process is then."""
    key = service.key("ingest")
    for number in range(12):
        write_whole(folder / f"pass-{number:02d}.csv", telemetry(number))
    for wanted in (3, 6, 9):
        process = watch(folder, satellite, service.url, key)
        until(lambda wanted=wanted: len(receipts(folder)) >= wanted)
        process.kill()
        process.wait(timeout=WAIT_S)
    watch(folder, satellite, service.url, key)
    until(lambda: len(names(folder / "sent")) == 12)
    assert names(folder) == []
    assert len(sessions(api, satellite)) == 12
    assert {one["session_id"] for one in receipts(folder)} == {one["id"] for one in sessions(api, satellite)}


def test_a_kill_between_the_service_s_work_and_its_answer_makes_no_second_session(
    service, api, satellite, folder, watch
):
    key = service.key("ingest")
    write_whole(folder / "pass.csv", telemetry(0))
    with relay(service.url, answers=False) as (url, passed):
        process = watch(folder, satellite, url, key)
        assert passed.wait(WAIT_S)
        process.kill()
        process.wait(timeout=WAIT_S)
    assert len(sessions(api, satellite)) == 1
    assert names(folder) == ["pass.csv"]
    assert push(folder, satellite, service.url, key).returncode == 0
    assert len(sessions(api, satellite)) == 1
    assert names(folder / "sent") == ["pass.csv"]


def test_bytes_that_were_acknowledged_are_not_sent_again(service, satellite, folder):
    """The second time nobody listens: what has its receipt needs no service."""
    key = service.key("ingest")
    write_whole(folder / "pass.csv", telemetry(0))
    assert push(folder, satellite, service.url, key).returncode == 0
    (folder / "sent" / "pass.csv").rename(folder / "again.csv")
    assert push(folder, satellite, "http://127.0.0.1:9", key).returncode == 0
    assert names(folder / "sent") == ["again.csv"]
    assert len(receipts(folder)) == 1


def test_passes_wait_out_a_service_that_is_away(service, api, satellite, folder, watch):
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        port = reserved.getsockname()[1]
    write_whole(folder / "pass.csv", telemetry(0))
    process = watch(folder, satellite, f"http://127.0.0.1:{port}", service.key("ingest"))
    assert process.stderr is not None
    assert "pass.csv: kept: unreachable" in process.stderr.readline()
    assert names(folder) == ["pass.csv"]
    upstream = ("127.0.0.1", int(service.url.rpartition(":")[2]))
    with socket.create_server(("127.0.0.1", port)) as listener:
        connection, _ = listener.accept()
        with connection, socket.create_connection(upstream, timeout=WAIT_S) as server:
            server.sendall(_whole_request(connection))
            connection.sendall(b"".join(iter(lambda: server.recv(1 << 16), b"")))
    until(lambda: names(folder / "sent") == ["pass.csv"])
    assert len(sessions(api, satellite)) == 1


def test_a_file_that_still_grows_is_not_sent(service, api, satellite, folder, watch):
    """Rows come more often than the settling time; then one writer keeps the file open through a long pause."""
    lines = telemetry(0).splitlines(keepends=True)
    watch(folder, satellite, service.url, service.key("ingest"))
    with (folder / "growing.csv").open("w") as growing:
        for line in lines[:10]:
            growing.write(line)
            growing.flush()
            time.sleep(0.1)
        time.sleep(1.5)
        assert names(folder) == ["growing.csv"]
        growing.writelines(lines[10:])
    until(lambda: names(folder) == [])
    assert [one["samples"] for one in sessions(api, satellite)] == [20]


def test_what_the_service_refuses_is_put_aside_with_its_faults(service, api, satellite, folder):
    (folder / "bad.csv").write_text("time,bx,by,bz\nyesterday,1,2,3\n")
    (folder / "good.csv").write_text(telemetry(0))
    done = push(folder, satellite, service.url, service.key("ingest"))
    assert done.returncode == 1
    assert "bad.csv: refused" in done.stderr
    assert "line 2, column time" in (folder / "refused" / "bad.csv.why").read_text()
    assert names(folder / "sent") == ["good.csv"]
    assert len(sessions(api, satellite)) == 1


def test_what_the_operator_must_put_right_is_kept(service, satellite, folder):
    (folder / "pass.csv").write_text(telemetry(0))
    for name, key in (("nowhere", service.key("ingest")), (satellite, service.key("read")), (satellite, "mgc_wrong")):
        done = push(folder, name, service.url, key)
        assert done.returncode == 1
        assert "pass.csv: kept" in done.stderr
    assert names(folder) == ["pass.csv"]


def test_another_pass_of_the_same_name_keeps_its_own_place(service, satellite, folder):
    key = service.key("ingest")
    for number in range(2):
        (folder / "pass.csv").write_text(telemetry(number))
        assert push(folder, satellite, service.url, key).returncode == 0
    kept = [path.read_text() for path in sorted((folder / "sent").glob("*.csv"), key=lambda path: len(path.name))]
    assert kept == [telemetry(0), telemetry(1)]


def test_two_processes_do_not_send_the_same_folder(service, satellite, folder, watch):
    key = service.key("ingest")
    watch(folder, satellite, service.url, key)
    until((folder / "sent").exists)
    second = push(folder, satellite, service.url, key)
    assert second.returncode == 1
    assert "another magcal push" in second.stderr
