"""Telemetry in and out: samples a second per format, beside what the bare parser and pandas reach, with memory."""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from benchmarks.measure import Figure, interleaved_s
from magcal_core.samples import Samples
from magcal_core.telemetry import WRITERS, read_telemetry, write_samples

ROOM = "ingest"
AIMS = {"csv": 2e6, "parquet": 8e6}
"""Samples a second."""


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
    import pandas as pd  # type: ignore[import-untyped]

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


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
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
