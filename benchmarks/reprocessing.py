"""A history reprocessed over PostgreSQL by 1, 2 and 4 worker processes: calibrations a second, from request to end.

``MAGCAL_BENCH_SESSIONS`` sessions of some 400 to 700 samples (default 300; 10,000 for the long run) and
``MAGCAL_BENCH_WORKERS`` numbers of workers, with commas (default 1,2,4).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx2

from benchmarks.measure import Figure
from benchmarks.service import cpu_s_of, postgres
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM = "reprocessing"
WORKERS = tuple(int(count) for count in os.environ.get("MAGCAL_BENCH_WORKERS", "1,2,4").split(","))
WARM_S = 20.0
RATE_AIM = 50.0
"""Of two workers, on two cores."""
MAGCAL = (sys.executable, "-c", "from app.cli.main import run; run()")


@contextmanager
def _process(environment: Mapping[str, str], log: Path, *command: str) -> Iterator[int]:
    with log.open("wb") as lines:
        process = subprocess.Popen([*MAGCAL, *command], env=os.environ | environment, stdout=lines, stderr=lines)
        try:
            yield process.pid
        finally:
            process.terminate()
            process.wait(60.0)


def _event(log: Path, name: str) -> dict[str, str]:
    """Return the first event ``name`` of a log, once it is there."""
    while True:
        for line in log.read_text().splitlines() if log.exists() else ():
            if line.startswith("{") and json.loads(line).get("event") == name:
                return dict(json.loads(line))
        time.sleep(0.1)


def _fill(api: httpx2.Client, count: int) -> None:
    """Keep ``count`` sessions that differ in their bytes."""
    api.post("/satellites", json={"id": "a"}).raise_for_status()
    api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
    api.post("/satellites/a/orbits", content=tle_text(), headers={"content-type": "text/plain"}).raise_for_status()
    lines = write_samples(simulated(SESSIONS[0]).samples, "csv").splitlines(keepends=True)
    for number in range(count):
        content = b"".join(lines[: len(lines) - number % 300]) + b"\n" * (number // 300)
        where = {"params": {"magnetometer": "m"}, "headers": {"content-type": "text/csv"}}
        api.post("/satellites/a/sessions", content=content, **where).raise_for_status()  # type: ignore[arg-type]


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    count = int(os.environ.get("MAGCAL_BENCH_SESSIONS", "300"))
    with tempfile.TemporaryDirectory(prefix="pg", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        with postgres(folder) as url:
            environment = {"MAGCAL_DATABASE_URL": url, "MAGCAL_DATA_DIR": str(folder / "data")}
            log = folder / "serve.log"
            with _process(environment, log, "serve", "--port", "0") as server:
                postmaster = int((folder / "pg" / "postmaster.pid").read_text().split()[0])
                address = _event(log, "listening")["url"]
                key = log.read_text().split("admin key: ")[1].split()[0]
                headers = {"Authorization": f"Bearer {key}"}
                with httpx2.Client(base_url=f"{address}/api/v1", headers=headers, timeout=300, trust_env=False) as api:
                    _fill(api, count)
                    for workers in WORKERS:
                        with _workers(environment, folder, workers) as pids:
                            yield from _measured(api, pids, [server, postmaster], count)


@contextmanager
def _workers(environment: Mapping[str, str], folder: Path, workers: int) -> Iterator[list[int]]:
    """Run ``workers`` worker processes and yield their ids once they are warm."""
    with ExitStack() as running:
        pids = []
        for number in range(workers):
            log = folder / f"worker-{workers}-{number}.log"
            pids.append(running.enter_context(_process(environment, log, "worker", "--concurrency", "1")))
            _event(log, "working")
        time.sleep(WARM_S)
        yield pids


def _measured(api: httpx2.Client, workers: Sequence[int], others: Sequence[int], count: int) -> Iterator[Figure]:
    """Yield the rate, and the processor's time of the calculations and of all the rest: workers, server, database."""
    before, rest_before = cpu_s_of(workers), cpu_s_of(others)
    start = time.perf_counter()
    job = api.post("/reprocessings", json={}).raise_for_status().json()
    while job["state"] == "running":
        time.sleep(0.2)
        job = api.get(f"/jobs/{job['id']}").json()
    rate = count / (time.perf_counter() - start)
    own_s, below_s = (now - then for now, then in zip(cpu_s_of(workers), before, strict=True))
    server_s = sum(cpu_s_of(others)) - sum(rest_before)
    what = f"{count} calibrations over {len(workers)} worker{'s' if len(workers) > 1 else ''}"
    yield Figure(ROOM, what, rate, "1/s", f">= {RATE_AIM:g}", rate >= RATE_AIM, json.dumps(job["result"]))
    outside, inside = 1e3 * (own_s + server_s) / count, 1e3 * below_s / count
    note = f"{inside:.1f} ms in the calculation, {1e3 * own_s / count:.1f} in the workers, "
    note += f"{1e3 * server_s / count:.1f} in server and database"
    what = f"processor outside the calculation, of a session, {what}"
    yield Figure(ROOM, what, outside / inside, "times", "<= 1", outside <= inside, note)
