"""Real servers and workers as processes of their own, which tests may kill, stop and starve."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx2

from magcal_core.simulation.dekart_mission import tle_text
from tests.faults.stem import LAUNCH, Forked, Stems

TRIALS = int(os.environ.get("MAGCAL_FAULT_TRIALS", "1"))
SEED = int(os.environ.get("MAGCAL_FAULT_SEED", "1"))
CSV = {"content-type": "text/csv"}
START_S = 60.0
"""How long a process may take to start."""

Process = subprocess.Popen[bytes] | Forked


class Site:
    """One database and the processes over it."""

    def __init__(self, folder: Path, database_url: str | None, stems: Stems) -> None:
        self.folder = folder
        self._stems = stems
        self.environment = {
            "MAGCAL_DATA_DIR": str(folder / "data"),
            "MAGCAL_MIN_FREE_MB": "0",
            **({"MAGCAL_DATABASE_URL": database_url} if database_url else {}),
        }
        self.prefix: list[str] = []
        """What a process is started with in front, which takes seconds; without, it is forked."""
        self.processes: list[Process] = []
        self.admin_key = ""

    @property
    def is_postgres(self) -> bool:
        return "MAGCAL_DATABASE_URL" in self.environment

    def start(self, *command: str, **environment: str) -> Process:
        """Start a magcal process; its log goes to a file of the site."""
        number = len(self.processes)
        whole = os.environ | self.environment | environment
        if not self.prefix:
            files = self.folder / f"{number}.log", self.folder / f"{number}.out"
            for file in files:
                file.touch()
            forked = self._stems.of(whole).fork(command, whole, *files)
            self.processes.append(forked)
            return forked
        with (self.folder / f"{number}.log").open("wb") as log, (self.folder / f"{number}.out").open("wb") as out:
            process = subprocess.Popen(
                [*self.prefix, sys.executable, str(LAUNCH), *command],
                env=whole,
                stdout=out,
                stderr=log,
            )
        self.processes.append(process)
        return process

    def log(self, process: Process) -> list[dict[str, object]]:
        """Return the log of a process, line by line."""
        lines = (self.folder / f"{self.processes.index(process)}.log").read_text().splitlines()
        return [json.loads(line) for line in lines if line.startswith("{")]

    def serve(self, workers: int = 1, **environment: str) -> tuple[Process, str]:
        """Return a server that listens, and its address."""
        process = self.start("serve", "--port", "0", "--workers", str(workers), **environment)
        deadline = time.monotonic() + START_S
        while not (url := next((one["url"] for one in self.log(process) if one.get("event") == "listening"), None)):
            assert process.poll() is None, self.raw_log(process)
            assert time.monotonic() < deadline
            time.sleep(0.05)
        with httpx2.Client(base_url=str(url), trust_env=False) as client:
            while not _answers(client):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        out = (self.folder / f"{self.processes.index(process)}.out").read_text()
        if out.startswith("admin key: "):
            self.admin_key = out.split()[2]
        return process, str(url)

    def raw_log(self, process: Process) -> str:
        return (self.folder / f"{self.processes.index(process)}.log").read_text()

    def worker(self, concurrency: int = 1, **environment: str) -> Process:
        """Return a worker process that takes jobs."""
        process = self.start("worker", "--concurrency", str(concurrency), **environment)
        deadline = time.monotonic() + START_S
        while not any(one.get("event") == "working" for one in self.log(process)):
            assert process.poll() is None, self.raw_log(process)
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return process

    def magcal(self, *command: str) -> int:
        """Return the status with which a command of the site's operator ended."""
        return self.start(*command).wait()

    def client(self, url: str) -> httpx2.Client:
        headers = {"Authorization": f"Bearer {self.admin_key}"}
        return httpx2.Client(base_url=f"{url}/api/v1", headers=headers, timeout=60.0, trust_env=False)

    def stop(self) -> None:
        """Stop every process that still runs."""
        for process in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self.processes:
            try:
                process.wait(60.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _answers(client: httpx2.Client) -> bool:
    try:
        return client.get("/healthz").status_code == 200
    except httpx2.TransportError:
        return False


def piece(telemetry: bytes, number: int) -> bytes:
    """Return a pass that no other number has: the first rows of ``telemetry``."""
    return b"".join(telemetry.splitlines(keepends=True)[: 20 + number % 600]) + b"\n" * (number // 600)


def prepare(api: httpx2.Client) -> None:
    """Register the satellite ``a`` with its magnetometer and its orbit."""
    api.post("/satellites", json={"id": "a"}).raise_for_status()
    api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
    api.post("/satellites/a/orbits", content=tle_text(), headers={"content-type": "text/plain"}).raise_for_status()


def upload(api: httpx2.Client, content: bytes, **headers: str) -> httpx2.Response:
    """Send telemetry of the satellite ``a``."""
    return api.post("/satellites/a/sessions", params={"magnetometer": "m"}, content=content, headers=CSV | headers)


def submit(api: httpx2.Client, session_id: str, **options: object) -> str:
    """Return the id of a new calibration job."""
    answer = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id], **options})
    answer.raise_for_status()
    return str(answer.json()["id"])


def wait_for(api: httpx2.Client, job_id: str, *states: str, timeout_s: float = 60.0) -> dict[str, object]:
    """Return the job once it is in one of ``states``."""
    deadline = time.monotonic() + timeout_s
    while True:
        job: dict[str, object] = api.get(f"/jobs/{job_id}").json()
        if job["state"] in states:
            return job
        assert time.monotonic() < deadline, job
        time.sleep(0.05)
