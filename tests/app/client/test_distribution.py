"""The client as a distribution of its own: small, for old Pythons, with few needs; told of ends instead of asking."""

from __future__ import annotations

import ast
import json
import shutil
import socket
import subprocess
import sys
import threading
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from app import client as app_client
from app.outbox.events import Event, EventType
from app.outbox.log import append, newest_position
from magcal_client import AsyncClient, Client, JobFailedError, ServiceAnswerError
from magcal_client.errors import ForeignAnswerError
from magcal_client.requests import format_of_name
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import SUFFIXES, write_samples
from magcal_core.telemetry import format_of_name as format_of_the_core
from tests.apart import run_apart

HOME = Path(__file__).resolve().parents[3] / "magcal_client"
CSV = b"time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"


def test_it_is_small_reads_as_python_3_9_and_needs_only_what_it_says():
    """The wheel holds these files, packed; unpacked they are below its limit of 100 kB already."""
    files = sorted(HOME.glob("*.py"))
    assert sum(one.stat().st_size for one in files) < 100_000
    project = tomllib.loads((HOME / "pyproject.toml").read_text())
    needed = {one.partition(">")[0] for one in project["project"]["dependencies"]}
    assert needed == {"httpx2", "click", "rich"}
    listed = set(project["tool"]["hatch"]["build"]["targets"]["wheel"]["only-include"])
    assert listed == {one.name for one in files} | {"py.typed"}
    allowed = needed | {"magcal_client", "pandas"} | set(sys.stdlib_module_names)
    for path in files:
        tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 9))
        for node in ast.walk(tree):
            names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert {one.partition(".")[0] for one in names} <= allowed, path.name


def test_no_line_needs_a_newer_python_than_3_9():
    """By `vermin`, which knows since when every construct, module, function and argument exists."""
    done = subprocess.run(
        [Path(sys.executable).with_name("vermin"), "-t=3.9-", "--no-tips", "--no-parse-comments", HOME],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "Minimum required versions: 3." in done.stdout


def test_its_wheel_is_below_100_kb_and_is_whole_by_itself(tmp_path):
    """Built as it is published; imported from the wheel alone, with nothing of the service on the path."""
    source = tmp_path / "source"
    shutil.copytree(HOME, source, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path]
    subprocess.run(command, cwd=source, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("magcal_client-*.whl")
    assert wheel.stat().st_size < 100_000
    with zipfile.ZipFile(wheel) as packed:
        names = {one for one in packed.namelist() if one.startswith("magcal_client/")}
        metadata = next(packed.read(one).decode() for one in packed.namelist() if one.endswith("METADATA"))
    assert names == {f"magcal_client/{one.name}" for one in HOME.glob("*.py")} | {"magcal_client/py.typed"}
    assert "Requires-Python: >=3.9" in metadata
    code = "import sys; sys.path.insert(0, sys.argv[1]); import magcal_client.push as one; print(one.__file__)"
    command = [sys.executable, "-W", "error", "-c", code, str(wheel)]
    assert subprocess.check_output(command, cwd=tmp_path, text=True).startswith(str(wheel))


def test_tables_come_as_data_frames(service, satellite):
    """The rows that were sent, with times in UTC; from both clients."""
    telemetry = write_samples(simulated(SESSIONS[0], 50).samples, "csv")
    with Client(service.url, service.admin_key) as client:
        session = client.upload(satellite, "mgm", telemetry, "text/csv")
        path = f"/sessions/{session['id']}/samples"
        frame = client.to_dataframe(path)

    async def fetch() -> object:
        async with AsyncClient(service.url, service.admin_key) as awaiting:
            return await awaiting.to_dataframe(path)

    sent = [line.split(",") for line in telemetry.decode().splitlines()]
    assert len(frame) == len(sent) - 1
    assert str(frame["time"].dt.tz) == "UTC"
    assert frame["bx"].tolist() == [float(row[sent[0].index("bx")]) for row in sent[1:]]
    assert frame.equals(run_apart(fetch()))


def test_the_services_own_client_is_the_same():
    assert app_client.Client is Client
    assert app_client.AsyncClient is AsyncClient


@pytest.mark.parametrize("ending", ["", ".gz", ".zst", ".zstd"])
def test_it_knows_files_by_their_names_as_the_core_does(ending):
    for suffix in [*SUFFIXES, ".bin", ""]:
        path = Path(f"pass.2026-01-01{suffix}{ending}")
        assert format_of_name(path) == format_of_the_core(path), path


def test_it_is_told_when_a_job_has_ended_and_asks_nothing_meanwhile(new_service):
    """A job that nobody works on, cancelled two seconds later: one stream, and not one look more."""
    service = new_service()
    asked: list[str] = []
    steps: list[float] = []
    with service.client() as api, Client(service.url, service.admin_key) as client:
        client.create_satellite("a")
        client.create_magnetometer("a", "mgm", "nT")
        session = client.upload("a", "mgm", CSV, "text/csv")

        def cancel() -> None:
            (job,) = api.get("/jobs").json()["items"]
            api.post(f"/jobs/{job['id']}/cancel").raise_for_status()

        client._http.event_hooks["request"].append(lambda one: asked.append(f"{one.method} {one.url.path}"))
        timer = threading.Timer(2.0, cancel)
        timer.start()
        with pytest.raises(JobFailedError, match="cancelled"):
            client.calibrate([str(session["id"])], steps.append, method="scalar")
        timer.join()
    assert [one.replace(one.split("/")[-2], "ID") if one.endswith("events") else one for one in asked] == [
        "POST /api/v1/jobs", "GET /api/v1/jobs/ID/events",
    ]  # fmt: skip
    assert steps == [0.0, 0.0]


def test_lists_are_walked_to_their_end(service, api, names):
    made = {next(names) for _ in range(7)}
    for name in made:
        api.post("/satellites", json={"id": name}).raise_for_status()
    with Client(service.url, service.admin_key) as client:
        found = [str(one["id"]) for one in client.items("/satellites", limit="3")]
    assert len(found) == len(set(found))
    assert made <= set(found)

    async def walk() -> list[str]:
        async with AsyncClient(service.url, service.admin_key) as awaiting:
            return [str(one["id"]) async for one in awaiting.items("/satellites", limit="3")]

    assert run_apart(walk()) == found


class Relay:
    """Carries streams to the service, and cuts each one after so many bytes of its answer."""

    def __init__(self, port: int, most_bytes: int) -> None:
        self._upstream, self._most = ("127.0.0.1", port), most_bytes
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.streams = 0
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.streams += 1
            with suppress(OSError), connection, socket.create_connection(self._upstream) as server:
                server.sendall(connection.recv(1 << 16))
                left = self._most
                while left > 0:
                    piece = server.recv(min(left, 1 << 16))
                    if not piece:
                        break
                    connection.sendall(piece)
                    left -= len(piece)

    def close(self) -> None:
        self._listener.close()


def test_a_stream_that_breaks_is_gone_on_with_where_it_broke(service, names):
    """Thirty events through a relay that cuts the line every 1,500 bytes, the first time before any event."""
    name = next(names)
    relay = Relay(int(service.url.rpartition(":")[2]), 1500)
    with service.database.read() as session:
        start = newest_position(session)
    with service.database.write() as session:
        append(session, [Event(EventType.ATTENTION_RAISED, {"cause": str(n)}, name) for n in range(30)])
    causes: list[str] = []
    with Client(relay.url, service.admin_key) as client:
        for event in client.follow(str(start), satellite=name):
            assert event.type == "attention.raised"
            data = event.data["data"]
            assert isinstance(data, dict)
            causes.append(str(data["cause"]))
            if len(causes) == 30:
                break
    relay.close()
    assert causes == [str(n) for n in range(30)]
    assert relay.streams > 3


def test_a_refused_set_is_activated_with_force_and_a_reason_and_rolled_back(service, satellite):
    with Client(service.url, service.admin_key) as client:
        client.send_orbits(satellite, tle_text())
        telemetry = write_samples(simulated(SESSIONS[0], 300).samples, "csv")
        session = client.upload(satellite, "mgm", telemetry, "text/csv")
        found = str(client.calibrate([str(session["id"])], method="vector")["id"])
        with service.database.write() as database:
            database.connection().exec_driver_sql("UPDATE parameter_set SET grade = 'refuse' WHERE id = ?", (found,))
        for wanted, force in (("verdict_refuse", False), ("reason_required", True)):
            with pytest.raises(ServiceAnswerError) as refused:
                client.activate(found, force=force)
            assert refused.value.code == wanted
        assert client.activate(found, force=True, reason="the spare is worse")["status"] == "active"
        assert client.roll_back(found)["status"] == "retired"
        lines = [one["reason"] for one in client.items("/audit") if one["subject"] == found]
    assert "the spare is worse" in lines


@contextmanager
def answering(*answers: tuple[int, str, bytes]) -> Iterator[str]:
    """Run something that gives each answer once, the last one for good; yield its address."""
    left = list(answers)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status, media_type, body = left.pop(0) if len(left) > 1 else left[0]
            self.send_response(status)
            self.send_header("content-type", media_type)
            self.send_header("content-length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


ENDED = b'data: {"state": "succeeded", "progress": 1.0}\n\n'


def waited(url: str) -> object:
    with Client(url, "key", tries=2) as client:
        return client.wait("a")["state"]


def awaited(url: str) -> object:
    async def wait() -> object:
        async with AsyncClient(url, "key", tries=2) as client:
            return (await client.wait("a"))["state"]

    return run_apart(wait())


@pytest.mark.parametrize("wait", [waited, awaited])
def test_a_stream_is_begun_anew_where_the_service_is_busy_and_given_up_where_it_is_not_the_service(wait):
    """A restart behind a proxy is 503 for a moment; a login page in the service's place is no end of a job."""
    with answering((503, "text/html", b"later"), (200, "text/event-stream; charset=utf-8", ENDED)) as url:
        assert wait(url) == "succeeded"
    with answering((503, "text/html", b"later")) as url, pytest.raises(ServiceAnswerError) as busy:
        wait(url)
    assert busy.value.status == 503
    with answering((200, "text/html", b"<h1>Log in</h1>")) as url, pytest.raises(ForeignAnswerError):
        wait(url)


def test_without_pandas_a_data_frame_is_refused_by_name(service, satellite, monkeypatch):
    with Client(service.url, service.admin_key) as client:
        session = client.upload(satellite, "mgm", CSV, "text/csv")
        monkeypatch.setitem(sys.modules, "pandas", None)
        with pytest.raises(Exception, match="needs pandas"):
            client.to_dataframe(f"/sessions/{session['id']}/samples")


def test_the_bodies_of_events_are_put_together_line_by_line():
    from magcal_client.events import EventReader

    reader = EventReader()
    lines = [": ping", "", "id: 7", "", "id:8", "event: job.ended", 'data: {"a":', "data: 1}", "", "data: 2"]
    found = [event for event in map(reader.take, lines) if event is not None]
    assert [(one.id, one.type, json.dumps(one.data)) for one in found] == [
        ("7", "", "{}"),
        ("8", "job.ended", '{"a": 1}'),
    ]
