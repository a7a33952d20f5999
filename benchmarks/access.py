"""What an answer's time tells of keys and bytes (A4, A7): interleaved requests over HTTP, medians and a rank test.

``MAGCAL_BENCH_PAIRS`` pairs (default 300; 10,000 for the long run).
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
from scipy.stats import mannwhitneyu

from app.database import Database
from app.keys.repository import KeyRepository
from app.logs import configure_logs
from app.server import listen, prepare, server_of
from app.settings import Settings
from benchmarks.measure import Figure

ROOM = "access"


@contextmanager
def _service(folder: Path) -> Iterator[tuple[str, Database]]:
    settings = Settings(data_dir=folder, workers=0, auth_failures_per_minute=10**9, log_level="warning")
    configure_logs(settings)
    prepare(settings)
    listener, server = listen("127.0.0.1", 0), server_of(settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    while not server.started:
        time.sleep(0.02)
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/api/v1", Database(settings)
    finally:
        server.should_exit = True
        thread.join()


def _compared(what: str, pairs: int, first: Callable[[int], object], second: Callable[[int], object]) -> Figure:
    """Return by how much the medians of two requests differ, percent, with the p-value of a rank test."""
    took_s = np.empty((pairs, 2))
    for number in range(pairs):
        order = (0, 1) if number % 2 else (1, 0)
        for side in order:
            begun = time.perf_counter()
            (first, second)[side](number)
            took_s[number, side] = time.perf_counter() - begun
    medians = np.median(took_s, axis=0)
    p_value = mannwhitneyu(took_s[:, 0], took_s[:, 1]).pvalue
    note = f"medians {medians[0] * 1e3:.3f} and {medians[1] * 1e3:.3f} ms, p = {p_value:.3f}, {pairs} pairs"
    return Figure(ROOM, what, 100.0 * abs(float(medians[0] / medians[1]) - 1.0), "%", note=note)


def _csv(number: int, satellite: int) -> bytes:
    rows = (f"2026-01-01T00:00:{i:02d}Z,{20_000 + number},{i},{satellite},36000" for i in range(40))
    return "\n".join(["time,bx,by,bz,ref_b", *rows, ""]).encode()


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    pairs = int(os.environ.get("MAGCAL_BENCH_PAIRS", "300"))
    with tempfile.TemporaryDirectory() as folder, _service(Path(folder)) as (url, database):
        with database.write() as session:
            keys = KeyRepository(session)
            admin, known = keys.create(["admin"]).key, keys.create(["read"]).key
            mine = keys.create(["ingest"], ["mine"]).key
        unknown = f"mgc_{'0' * 16}_{known[-43:]}"
        wrong = known[:-1] + ("A" if known[-1] != "A" else "B")
        with httpx2.Client(base_url=url, trust_env=False, timeout=60) as client:

            def ask(key: str, path: str = "/satellites") -> Callable[[int], object]:
                return lambda _number: client.get(path, headers={"Authorization": f"Bearer {key}"})

            headers = {"Authorization": f"Bearer {admin}"}
            for name in ("mine", "theirs"):
                client.post("/satellites", json={"id": name}, headers=headers).raise_for_status()
                body = {"id": "m", "unit": "nT"}
                client.post(f"/satellites/{name}/magnetometers", json=body, headers=headers).raise_for_status()
            yield _compared("an unknown key against a wrong secret", pairs, ask(unknown), ask(wrong))
            hidden, absent = ask(mine, "/satellites/theirs"), ask(mine, "/satellites/nowhere")
            yield _compared("another's satellite against none", pairs, hidden, absent)
            csv = {"content-type": "text/csv"}

            def send(name: str, key: str, content: bytes) -> None:
                where = f"/satellites/{name}/sessions?magnetometer=m"
                client.post(
                    where, content=content, headers={"Authorization": f"Bearer {key}", **csv}
                ).raise_for_status()

            for number in range(pairs):
                send("theirs", admin, _csv(number, 1))
            yield _compared(
                "bytes that another satellite has against bytes that none has",
                pairs,
                lambda number: send("mine", mine, _csv(number, 1)),
                lambda number: send("mine", mine, _csv(number, 2)),
            )
        database.close()
