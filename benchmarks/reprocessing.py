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
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx2

from benchmarks.measure import Figure
from benchmarks.service import postgres
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM = "reprocessing"
WORKERS = tuple(int(count) for count in os.environ.get("MAGCAL_BENCH_WORKERS", "1,2,4").split(","))
WARM_S = 20.0
MAGCAL = (sys.executable, "-c", "from app.cli.main import run; run()")


@contextmanager
def _process(environment: Mapping[str, str], log: Path, *command: str) -> Iterator[None]:
    with log.open("wb") as lines:
        process = subprocess.Popen([*MAGCAL, *command], env=os.environ | environment, stdout=lines, stderr=lines)
        try:
            yield
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
            with _process(environment, log, "serve", "--port", "0"):
                address = _event(log, "listening")["url"]
                key = log.read_text().split("admin key: ")[1].split()[0]
                headers = {"Authorization": f"Bearer {key}"}
                with httpx2.Client(base_url=f"{address}/api/v1", headers=headers, timeout=300, trust_env=False) as api:
                    _fill(api, count)
                    for workers in WORKERS:
                        yield _measured(api, environment, folder, workers, count)


def _measured(api: httpx2.Client, environment: Mapping[str, str], folder: Path, workers: int, count: int) -> Figure:
    with ExitStack() as running:
        for number in range(workers):
            log = folder / f"worker-{workers}-{number}.log"
            running.enter_context(_process(environment, log, "worker", "--concurrency", "1"))
            _event(log, "working")
        time.sleep(WARM_S)
        start = time.perf_counter()
        job = api.post("/reprocessings", json={}).raise_for_status().json()
        while job["state"] == "running":
            time.sleep(0.2)
            job = api.get(f"/jobs/{job['id']}").json()
        rate = count / (time.perf_counter() - start)
    what = f"{count} calibrations over {workers} worker{'s' if workers > 1 else ''}"
    return Figure(ROOM, what, rate, "1/s", note=json.dumps(job["result"]))
