"""The client and the commands over it, against a real server and real network faults."""

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from app.client.asynchronous import AsyncClient
from app.client.blocking import (
    Client,
    JobFailedError,
    Record,
    ServiceAnswerError,
    ServiceUnreachableError,
    media_type_of,
)
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import read_samples, write_samples
from tests.apart import run_apart
from tests.faults.stem import Stems

ROOT = Path(__file__).resolve().parents[3]
CSV = b"time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n2026-01-01T00:00:10Z,20001,1,2,20000\n"


@pytest.fixture
def magcal(stems: Stems, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., subprocess.CompletedProcess[str]]:
    """What runs a command in a process that need not import magcal anew."""
    return partial(stems.run, folder=tmp_path_factory.mktemp("commands"))


def run_installed(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command that is installed."""
    command = [Path(sys.executable).with_name("magcal"), *arguments]
    return subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def client(service):
    with Client(service.url, service.admin_key) as client:
        yield client


def test_pushing_a_file_twice_leaves_one_session(service, satellite, tmp_path, magcal):
    path = tmp_path / "pass.csv"
    path.write_bytes(CSV)
    arguments = ("push", str(path), "--satellite", satellite, "--magnetometer", "mgm", "--url", service.url, "--json")
    first, second = (magcal(*arguments, MAGCAL_KEY=service.key("ingest")) for _ in range(2))
    assert (first.returncode, second.returncode) == (0, 0), first.stderr
    assert json.loads(first.stdout)["id"] == json.loads(second.stdout)["id"]


def test_a_push_that_fails_says_why_in_one_line_and_exits_1(service, tmp_path, magcal):
    path = tmp_path / "pass.csv"
    path.write_bytes(CSV)
    failed = magcal(
        *("push", str(path), "--satellite", "nowhere", "--magnetometer", "mgm", "--url", service.url),
        MAGCAL_KEY=service.admin_key,
    )
    assert failed.returncode == 1
    assert failed.stderr == "magcal: not_found: no such satellite\n"


def whole_request(connection: socket.socket) -> bytes:
    """Return a request with a body as long as its Content-Length says."""
    request = connection.recv(1 << 16)
    while b"\r\n\r\n" not in request:
        request += connection.recv(1 << 16)
    head, _, body = request.partition(b"\r\n\r\n")
    length = next(int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:"))
    while len(body) < length:
        body += connection.recv(1 << 16)
    return head.replace(b"keep-alive", b"close") + b"\r\n\r\n" + body


@contextmanager
def unsteady(service) -> Iterator[tuple[str, list[bytes]]]:
    """Yield the address of a relay that loses one request, then one answer; and the statuses that the service gave."""
    upstream = ("127.0.0.1", int(service.url.rpartition(":")[2]))
    statuses: list[bytes] = []

    def relay(listener: socket.socket) -> None:
        for number in range(3):
            connection, _ = listener.accept()
            with connection:
                request = whole_request(connection)
                if number == 0:
                    continue
                with socket.create_connection(upstream, timeout=60) as server:
                    server.sendall(request)
                    answer = b"".join(iter(lambda: server.recv(1 << 16), b""))
                statuses.append(answer[9:12])
                if number == 2:
                    connection.sendall(answer)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(60)
        thread = threading.Thread(target=relay, args=(listener,))
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", statuses
        thread.join()


def sent_through(url: str, key: str, satellite: str) -> Record:
    with Client(url, key) as client:
        return client.upload(satellite, "mgm", CSV, "text/csv")


def sent_awaiting(url: str, key: str, satellite: str) -> Record:
    async def send() -> Record:
        async with AsyncClient(url, key) as client:
            return await client.upload(satellite, "mgm", CSV, "text/csv")

    return run_apart(send())


@pytest.mark.parametrize("send", [sent_through, sent_awaiting])
def test_both_clients_try_again_when_the_connection_is_cut(service, satellite, send):
    """The first request is lost, the answer to the second is, and the third is answered: one session is kept."""
    with unsteady(service) as (url, statuses):
        session = send(url, service.admin_key, satellite)
    assert statuses == [b"201", b"200"]
    with service.client() as api:
        kept = api.get("/sessions", params={"satellite": satellite}).json()["items"]
    assert [one["id"] for one in kept] == [session["id"]]


def test_the_async_client_walks_the_whole_way(service, satellite):
    """Register, upload, calibrate, read, correct and take back: 1e-6 nT is what a CSV round trip leaves."""
    clean = simulated(SESSIONS[0], 300).samples
    telemetry = write_samples(clean, "csv")
    shares, steps = [], []

    async def way() -> tuple[Record, bytes]:
        async with AsyncClient(service.url, service.admin_key) as client:
            await client.create_satellite(satellite)
            await client.create_magnetometer(satellite, "mgm", "nT")
            await client.send_orbits(satellite, tle_text())
            session = await client.upload(satellite, "mgm", telemetry, "text/csv", shares.append)
            found = await client.calibrate([str(session["id"])], steps.append, method="vector")
            listed = await client.get("/parameter-sets", satellite=satellite)
            assert [one["id"] for one in listed["items"]] == [found["id"]]
            assert b"MAGCAL_BIAS_NT" in await client.download(f"/parameter-sets/{found['id']}/export", format="c")
            corrected = await client.apply(str(found["id"]), telemetry, "text/csv")
            return found, await client.apply(str(found["id"]), corrected, "text/csv", inverse=True)

    found, back = run_apart(way())
    assert found["method"] == "vector"
    assert shares[-1] == 1.0
    np.testing.assert_allclose(read_samples(back).h_nt, clean.h_nt, atol=1e-6)


def test_a_service_that_is_not_there_is_told_after_the_last_try():
    with Client("http://127.0.0.1:9", "key", tries=1) as client, pytest.raises(ServiceUnreachableError):
        client.create_satellite("x")


def test_a_refusal_carries_code_and_faults(client, satellite):
    with pytest.raises(ServiceAnswerError, match="line 2, column bx") as refused:
        client.upload(satellite, "mgm", b"time,bx,by,bz\n2026-01-01T00:00:00Z,x,1,2\n", "text/csv")
    assert refused.value.status == 422


def test_a_failed_calibration_says_why(client, satellite):
    session = client.upload(satellite, "mgm", CSV, "text/csv")
    with pytest.raises(JobFailedError, match="samples"):
        client.calibrate([str(session["id"])])


def test_media_types_follow_the_name():
    names = ("a.csv", "a.csv.gz", "a.ndjson", "a.json", "a.parquet", "a.bin")
    kinds = [media_type_of(Path(name)).rpartition("/")[2] for name in names]
    assert kinds == ["csv", "csv", "x-ndjson", "json", "vnd.apache.parquet", "octet-stream"]


def test_keys_are_made_listed_and_revoked_on_the_command_line(tmp_path, magcal):
    folder = {"MAGCAL_DATA_DIR": str(tmp_path)}
    assert magcal("db", "upgrade", **folder).returncode == 0
    made = magcal("keys", "create", "--scopes", "read,ingest", "--satellites", "a,b", "--json", **folder)
    record = json.loads(made.stdout)
    assert record["key"].startswith(f"mgc_{record['id']}_")
    assert (record["scopes"], record["satellites"]) == (["ingest", "read"], ["a", "b"])
    plain = magcal("keys", "create", "--scopes", "admin", "--expires", "2100-01-01T00:00:00Z", **folder)
    assert plain.stdout.startswith("mgc_")
    assert magcal("keys", "revoke", record["id"], **folder).returncode == 0
    listed = json.loads(magcal("keys", "list", "--json", **folder).stdout)
    assert {one["id"]: one["revoked_at"] is not None for one in listed} == {
        record["id"]: True,
        plain.stdout.split("_")[1]: False,
    }
    assert record["key"] not in magcal("keys", "list", **folder).stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_are_told_how_to_complete(shell):
    done = run_installed(_MAGCAL_COMPLETE=f"{shell}_source")
    assert done.returncode == 0, done.stderr
    assert f"_MAGCAL_COMPLETE={shell}_complete" in done.stdout
    page = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert f"_MAGCAL_COMPLETE={shell}_source magcal" in page


@pytest.mark.parametrize(
    ("words", "wanted"),
    [("magcal cal", "calibrate"), ("magcal push --wa", "--watch"), ("magcal calibrate --unit m", "mT")],
)
def test_commands_options_and_values_are_completed(words, wanted):
    last = str(len(words.split()) - 1)
    done = run_installed(_MAGCAL_COMPLETE="bash_complete", COMP_WORDS=words, COMP_CWORD=last)
    assert f"plain,{wanted}" in done.stdout.splitlines()


def test_wrong_usage_exits_2_and_a_missing_key_exits_1(tmp_path, magcal):
    folder = {"MAGCAL_DATA_DIR": str(tmp_path)}
    assert magcal("keys", "create", "--scopes", "everything", **folder).returncode == 2
    assert magcal("keys", "create", "--scopes", "read", "--expires", "tomorrow", **folder).returncode == 2
    assert magcal("db", "upgrade", **folder).returncode == 0
    missing = magcal("keys", "revoke", "0123456789abcdef", **folder)
    assert missing.returncode == 1
    assert missing.stderr.splitlines()[-1] == "magcal: not_found: no such key"


def test_the_schema_can_be_upgraded_and_shown(tmp_path, magcal):
    folder = {"MAGCAL_DATA_DIR": str(tmp_path)}
    assert magcal("db", "current", **folder).stdout.startswith("empty")
    revision = magcal("db", "upgrade", **folder).stdout.strip()
    assert magcal("db", "current", **folder).stdout.strip() == f"{revision} (this version needs {revision})"


def test_the_demonstration_finds_the_truth_and_exits():
    done = run_installed("demo", "--once")
    assert done.returncode == 0, done.stderr
    for line in ("session 1, 700 samples", "session 2, 1400 samples", "drift between the sessions"):
        assert line in done.stdout
    assert done.stdout.count("accept") == 8
