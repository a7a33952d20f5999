"""Telemetry in and out: samples a second per format, beside what the bare parser and pandas reach, with memory."""

from __future__ import annotations

import io
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from sqlalchemy import func, select

from app.access.caller import SYSTEM
from app.sessions.repository import SessionRepository, samples_of
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import Database
from app.storage.database_store import BlobPart
from app.storage.open_store import open_store
from benchmarks.measure import Figure, interleaved_s
from benchmarks.service import LeanClient, request_of, scratch, service
from magcal_core.samples import Samples
from magcal_core.telemetry import WRITERS, read_telemetry, write_samples

ROOM = "ingest"
AIMS = {"csv": 2e6, "parquet": 8e6}
"""Samples a second."""
_UPLOADS = 3
"""Of different bytes, after a short one: their median is told."""
KINDS = {"csv": "text/csv", "parquet": "application/vnd.apache.parquet"}


def session(n: int) -> Samples:
    """Return ``n`` samples at 1 Hz with readings to 0.01 nT, as a sensor's converter gives them."""
    t_utc = np.datetime64("2022-02-19T22:37:44.130", "ns") + np.arange(n) * np.timedelta64(1, "s")
    turns = np.outer(np.arange(n), [0.0131, 0.0127, 0.0113])
    h_nt = 30_000.0 * np.sin(turns) + np.random.default_rng(1).normal(0.0, 100.0, (n, 3))
    return Samples(t_utc, h_nt.round(2))


def _bare_csv(body: bytes) -> object:
    kinds = {"time": pa.timestamp("ns", "UTC"), "bx": pa.float64(), "by": pa.float64(), "bz": pa.float64()}
    return pacsv.read_csv(pa.BufferReader(body), convert_options=pacsv.ConvertOptions(column_types=kinds))


def _bare_parquet(body: bytes) -> object:
    return pq.read_table(pa.BufferReader(body))


def _pandas_csv(body: bytes) -> object:
    import pandas as pd

    return pd.read_csv(io.BytesIO(body), parse_dates=["time"])


def _peak_mib(n: int) -> float:
    """Return the peak memory of reading ``n`` samples from CSV, less what the process has before and the body, MiB."""
    code = (
        "import pathlib, sys\n"
        "from magcal_core.telemetry import read_telemetry\n"
        "status = pathlib.Path('/proc/self/status')\n"
        "peak = lambda: int(status.read_text().split('VmHWM:')[1].split()[0]) / 1024\n"
        "read_telemetry(b'time,bx,by,bz\\n1645310264,30000,1,2\\n', format='csv')\n"
        "before = peak(); read_telemetry(sys.argv[1]); print(peak() - before)\n"
    )
    with tempfile.NamedTemporaryFile(suffix=".csv") as file:
        body = write_samples(session(n), "csv")
        file.write(body)
        file.flush()
        done = subprocess.run([sys.executable, "-c", code, file.name], capture_output=True, check=True)
    return float(done.stdout) - len(body) / 2**20


def _reading(body: bytes, kind: str) -> Callable[[], object]:
    return lambda: read_telemetry(body, format=kind)


def _writing(samples: Samples, kind: str) -> Callable[[], object]:
    return lambda: write_samples(samples, kind)


def _durable() -> Iterator[Figure]:
    """Yield what an upload costs from its socket to the durable store, what it takes there, and reading it back."""
    n = 1_000_000
    with scratch() as folder, service(folder, "--workers", "0", MIN_FREE_MB="0") as running, running.client() as api:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        for kind, media_type in KINDS.items():
            bodies = [write_samples(session(rows), kind) for rows in (1000, *range(n - _UPLOADS + 1, n + 1))]
            spent = []
            client = LeanClient(running.port)
            for body in bodies:
                cpu_s, begun = running.process.cpu_s(), time.perf_counter()
                status, _, answer = client.ask(_upload(running.key, body, media_type))
                spent.append((time.perf_counter() - begun, running.process.cpu_s() - cpu_s))
                if status != 201:
                    raise RuntimeError(answer.decode())
            client.close()
            elapsed_s, cpu_s = (statistics.median(one) for one in zip(*spent[1:], strict=True))
            note = f"{n / cpu_s:.3g} a second of processor; {len(body) / n:.1f} bytes a sample as sent"
            aim = AIMS[kind]
            what = f"{kind} from socket to durable store, 1e6 samples"
            yield Figure(ROOM, what, n / elapsed_s, "samples/s", f">= {aim:g}", n / elapsed_s >= aim, note)
            if kind == "parquet":
                kept = json.loads(answer)["id"]
        short = write_samples(session(100_000), "parquet")
        client = LeanClient(running.port)
        client.ask(_upload(running.key, short, KINDS["parquet"]))
        client.close()
        yield from _stored(Settings(data_dir=folder / "data"), kept, n)


def _upload(key: str, body: bytes, media_type: str) -> bytes:
    return request_of("POST", "/satellites/a/sessions?magnetometer=m", key, {"Content-Type": media_type}, body)


def _stored(settings: Settings, session_id: str, n: int) -> Iterator[Figure]:
    database, store = Database(settings), open_store(settings)
    sizes = select(func.sum(func.length(BlobPart.content)))
    with database.read() as opened:
        size = opened.scalar(sizes.where(BlobPart.key.startswith(f"columns/{session_id}/"))) or 0
        newest = select(TelemetrySession.id).where(TelemetrySession.samples == 100_000)
        short_id = opened.scalar(newest) or ""

    def read() -> object:
        with database.read() as opened:
            return samples_of(SessionRepository(opened, SYSTEM).columns(short_id, store))

    yield Figure(ROOM, "columnar store, lossless", size / n, "bytes a sample", "<= 15", size / n <= 15)
    took_ms = 1e3 * interleaved_s({"read": read}, rounds=9)["read"]
    yield Figure(ROOM, "a session of 1e5 read back and verified", took_ms, "ms", "<= 5", took_ms <= 5)
    database.close()


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    yield from _durable()
    n = 1_000_000
    bodies = {kind: write_samples(session(n), kind) for kind in WRITERS}
    runs = {kind: _reading(body, kind) for kind, body in bodies.items()} | {
        "bare Arrow CSV": lambda: _bare_csv(bodies["csv"]),
        "bare Arrow Parquet": lambda: _bare_parquet(bodies["parquet"]),
        "pandas CSV": lambda: _pandas_csv(bodies["csv"]),
    }
    durations = interleaved_s(runs, rounds=5)
    for name, duration_s in durations.items():
        rate, aim = n / duration_s, AIMS.get(name)
        note = f"{len(bodies[name]) / n:.1f} bytes a sample" if name in bodies else ""
        is_met = None if aim is None else rate >= aim
        yield Figure(ROOM, f"read {name}, 1e6 samples", rate, "samples/s", f">= {aim:g}" if aim else "", is_met, note)
    ratio = durations["csv"] / durations["bare Arrow CSV"]
    yield Figure(ROOM, "read CSV, checked and flagged, against bare Arrow", ratio, "times", "<= 1.5", ratio <= 1.5)
    for count in (100, 10_000, 100_000):
        run = _reading(write_samples(session(count), "csv"), "csv")
        yield Figure(ROOM, f"read CSV, {count} samples", 1e3 * interleaved_s({"csv": run})["csv"], "ms")
    peak = _peak_mib(n)
    yield Figure(ROOM, "memory to read 1e6 samples from CSV, beside the body", peak, "MiB", "<= 600", peak <= 600.0)
    short = session(100_000)
    writing = interleaved_s({kind: _writing(short, kind) for kind in WRITERS}, rounds=5)
    for kind, duration_s in writing.items():
        yield Figure(ROOM, f"write {kind}, 1e5 samples", len(short) / duration_s, "samples/s")
