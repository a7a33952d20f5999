"""L1 to L6, L9 and L10: clients against a real server on the same machine, and every acknowledged body read back.

Each case takes ``MAGCAL_BENCH_LOAD_S`` seconds (default 10), the soak ``MAGCAL_BENCH_SOAK_S`` (default 120). The
clients share the machine's cores with the server. What was acknowledged is looked for in the database afterwards,
byte for byte, so that "lost" is a figure and not a hope.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import os
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from sqlalchemy import select

from app.database import Database
from app.demo.mission import tle_text
from app.sessions.tables import Chunk
from app.settings import Settings
from app.store import open_store, raw_key
from benchmarks.measure import Figure
from benchmarks.service import LeanClient, Service, length_of, request_of, scratch, service
from magcal_core.telemetry import read_telemetry, write_samples

ROOM: Final = "load"
CASE_S: Final = float(os.environ.get("MAGCAL_BENCH_LOAD_S", "10"))
SOAK_S: Final = float(os.environ.get("MAGCAL_BENCH_SOAK_S", "120"))
PATH: Final = "/satellites/load/sessions?magnetometer=mgm"
NUMBERS: Final = itertools.count()
POLLERS: Final = 50
RETRY_AFTER_S: Final = 1.0
"""What refusals say, and clients do."""
LIMITS: Final = {"MIN_FREE_MB": "0", "MAX_UPLOADS_PER_KEY": "64", "MAX_UPLOAD_MB": "200", "MAX_ROWS": "3000000"}


@dataclass(slots=True)
class Seen:
    """What clients saw: durations of accepted and of refused requests, s, and what was acknowledged."""

    accepted_s: list[float] = field(default_factory=list)
    refused_s: list[float] = field(default_factory=list)
    statuses: Counter[int] = field(default_factory=Counter)
    resets: int = 0
    unexplained: int = 0
    sha256: list[str] = field(default_factory=list)
    size_bytes: int = 0

    def note(self, status: int, head: bytes, body: bytes, took_s: float) -> None:
        """Note one answer to the upload of ``body``."""
        self.statuses[status] += 1
        if status in {200, 201}:
            self.accepted_s.append(took_s)
            self.sha256.append(hashlib.sha256(body).hexdigest())
            self.size_bytes += len(body)
            return
        self.refused_s.append(took_s)
        self.unexplained += int(status not in {429, 503} or b"retry-after" not in head.lower())


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder, service(folder, "--workers", "0", **LIMITS) as running:
        prepare_load(running)
        yield from _sizes(running, folder)
        yield from _crowds(running, folder)
        yield from _polling(running, folder)
        yield from _soak(running, folder)
    with scratch() as folder, service(folder, "--workers", "1", **LIMITS) as running:
        prepare_load(running)
        yield from _long_session(running)
    with scratch() as folder, service(folder, "--workers", "0", UPLOAD_STALL_S="3", **LIMITS) as running:
        prepare_load(running)
        yield from asyncio.run(_slow(running))


def prepare_load(running: Service) -> None:
    with running.client() as api:
        api.post("/satellites", json={"id": "load"}).raise_for_status()
        api.post("/satellites/load/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        plain = {"Content-Type": "text/plain"}
        api.post("/satellites/load/orbits", content=tle_text(), headers=plain).raise_for_status()


class Bodies:
    """Telemetry of about one size, no two bodies alike."""

    def __init__(self, size_bytes: int) -> None:
        rows = max(2, size_bytes // 48)
        t_utc = np.datetime_as_string(
            np.datetime64("2022-02-19T22:37:44.130", "ms") + 100 * np.arange(rows), unit="ms", timezone="UTC"
        )
        turns = np.outer(np.arange(rows), [0.0131, 0.0127, 0.0113])
        h_nt = 30_000.0 * np.sin(turns)
        lines = (f"{t},{x:.3f},{y:.3f},{z:.3f}\n" for t, (x, y, z) in zip(t_utc, h_nt, strict=True))
        self._body = "".join(["time,bx,by,bz\n", *lines]).encode()

    def next(self) -> bytes:
        """Return another body: the same samples with a reading of its own."""
        number = next(NUMBERS)
        own = f"2022-02-19T22:37:40.000Z,{10_000 + number % 20_000},{number // 20_000}.5,30000\n"
        return self._body + own.encode()


async def _ask(
    connection: tuple[asyncio.StreamReader, asyncio.StreamWriter], request: bytes
) -> tuple[int, bytes, bytes]:
    reader, writer = connection
    writer.write(request)
    await writer.drain()
    head = await reader.readuntil(b"\r\n\r\n")
    status = int(head[9:12])
    return status, head, await reader.readexactly(length_of(head))


async def _uploading(running: Service, bodies: Bodies, seen: Seen, until: float, pause_s: float = 0.0) -> None:
    """Upload one body after the other on one connection, which is opened anew where the server has closed it."""
    connection = None
    while time.monotonic() < until:
        body = bodies.next()
        request = request_of("POST", PATH, running.key, {"Content-Type": "text/csv"}, body)
        begun = time.perf_counter()
        try:
            connection = connection or await asyncio.open_connection("127.0.0.1", running.port)
            status, head, _ = await _ask(connection, request)
        except (ConnectionError, asyncio.IncompleteReadError):
            seen.resets += 1
            connection = None
            continue
        seen.note(status, head, body, time.perf_counter() - begun)
        if b"connection: close" in head.lower():
            connection[1].close()
            connection = None
        await asyncio.sleep(pause_s if status in {200, 201} else RETRY_AFTER_S)
    if connection is not None:
        connection[1].close()


async def together(running: Service, clients: int, bodies: Bodies, duration_s: float, pause_s: float = 0.0) -> Seen:
    seen, until = Seen(), time.monotonic() + duration_s
    await asyncio.gather(*(_uploading(running, bodies, seen, until, pause_s) for _ in range(clients)))
    return seen


def _lost(folder: Path, sha256: Sequence[str]) -> int:
    """Return how many acknowledged bodies the store does not give back, byte for byte."""
    settings = Settings(data_dir=folder / "data")
    database, store, lost = Database(settings), open_store(settings), 0
    for one in sha256:
        with database.read() as session:
            known = session.scalar(select(Chunk.sha256).where(Chunk.sha256 == one).limit(1))
            content = b"" if known is None else store.get(session, raw_key("load", one), one)
        lost += int(hashlib.sha256(content).hexdigest() != one)
    database.close()
    return lost


def p99_of(durations_s: Sequence[float]) -> float:
    return float(np.quantile(durations_s, 0.99)) if durations_s else float("nan")


def _sizes(running: Service, folder: Path) -> Iterator[Figure]:
    """Yield L1 to L3: uploads of 10 kB, 1 MB and 10 MB by many clients."""
    cases = (("L1", 32, 10_000, 200.0, 0.75), ("L2", 32, 1_000_000, 120.0, 1.0), ("L3", 16, 10_000_000, 8.5, None))
    for name, clients, size, rate_aim, p99_aim in cases:
        bodies = Bodies(size)
        asyncio.run(together(running, clients, bodies, 1.0))
        rss = running.process.rss_mib()
        begun, cpu_s = time.perf_counter(), running.process.cpu_s()
        seen = asyncio.run(together(running, clients, bodies, CASE_S))
        elapsed_s, cpu_s = time.perf_counter() - begun, running.process.cpu_s() - cpu_s
        count = max(1, len(seen.accepted_s))
        rate, what = len(seen.accepted_s) / elapsed_s, f"{name} {clients} clients, {size / 1e3:.0f} kB"
        note = f"{1e3 * cpu_s / count:.1f} ms of the server's processor each; {dict(seen.statuses)}"
        yield Figure(ROOM, what, rate, "1/s", f">= {rate_aim:g}", rate >= rate_aim, note)
        if p99_aim is not None:
            p99 = p99_of(seen.accepted_s)
            yield Figure(ROOM, f"{what}, p99", p99, "s", f"<= {p99_aim:g}", p99 <= p99_aim)
        else:
            growth = running.process.rss_mib() - rss
            yield Figure(ROOM, f"{what}, growth of memory", growth, "MiB", "<= 64", growth <= 64)
        yield _kept(what, folder, seen)


def _kept(what: str, folder: Path, seen: Seen) -> Figure:
    lost = _lost(folder, seen.sha256)
    return Figure(ROOM, f"{what}, acknowledged and lost", lost, f"of {len(seen.sha256)}", "0", lost == 0)


def _crowds(running: Service, folder: Path) -> Iterator[Figure]:
    """Yield L4: 200, then 1000 clients at once."""
    for clients in (200, 1000):
        seen = asyncio.run(together(running, clients, Bodies(10_000), CASE_S))
        what, odd = f"L4 {clients} clients at once", seen.resets + seen.unexplained
        note = f"{dict(seen.statuses)}, {seen.resets} resets"
        yield Figure(ROOM, f"{what}: resets, and refusals without Retry-After", odd, "", "0", odd == 0, note)
        accepted = p99_of(seen.accepted_s)
        yield Figure(ROOM, f"{what}: accepted, p99", accepted, "s", "<= 5", accepted <= 5)
        refused = statistics.median(seen.refused_s) if seen.refused_s else 0.0
        note = f"p99 {p99_of(seen.refused_s):.2f} s, of {len(seen.refused_s)}"
        yield Figure(ROOM, f"{what}: refused, median", refused, "s", "<= 0.1", refused <= 0.1, note)
        yield _kept(what, folder, seen)


async def _polled(port: int, poll: bytes, upload: bytes) -> tuple[list[float], bytes, float]:
    """Return what 50 polls a second took while ``upload`` went, s, with the head of its answer and its duration, s.

    Each client keeps to its own second, and a poll that it could not send in time counts from when it was due. The
    body is sent by a thread with a socket of its own, lest the clients wait for each other.
    """
    durations: list[float] = []
    done = asyncio.Event()

    async def client(number: int) -> None:
        connection = await asyncio.open_connection("127.0.0.1", port)
        due = begun + number / POLLERS
        while not done.is_set():
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            await _ask(connection, poll)
            durations.append(time.perf_counter() - due)
            due += 1.0
        connection[1].close()

    begun = time.perf_counter() + 0.1
    clients = [asyncio.create_task(client(number)) for number in range(POLLERS)]
    await asyncio.sleep(2.0)
    durations.clear()
    sent = time.perf_counter()
    _, head, _ = await asyncio.to_thread(LeanClient(port).ask, upload)
    took_s = time.perf_counter() - sent
    done.set()
    await asyncio.gather(*clients)
    return durations, head, took_s


def _polling(running: Service, folder: Path) -> Iterator[Figure]:
    """Yield L5: 50 clients that poll while 100 MiB arrive."""
    with running.client() as api:
        session = api.get("/sessions?limit=1").json()["items"][0]["id"]
    body, seen = Bodies(100 << 20).next(), Seen()
    upload = request_of("POST", PATH, running.key, {"Content-Type": "text/csv"}, body)
    poll = request_of("GET", f"/sessions/{session}", running.key)
    durations, head, took_s = asyncio.run(_polled(running.port, poll, upload))
    seen.note(int(head[9:12]), head, body, took_s)
    p99, what = p99_of(durations), "L5 status while 100 MiB arrive"
    note = f"{len(durations)} polls; the upload took {sum(seen.accepted_s):.1f} s: {dict(seen.statuses)}"
    yield Figure(ROOM, f"{what}, p99", 1e3 * p99, "ms", "<= 100", p99 <= 0.1, note)
    yield _kept(what, folder, seen)


def _long_session(running: Service) -> Iterator[Figure]:
    """Yield L6: from the first byte of 1e6 rows to flagged samples in the store."""
    rows = Bodies(48 * 1_000_000).next()
    for form, kind in (("csv", "text/csv"), ("parquet", "application/vnd.apache.parquet")):
        body = rows if form == "csv" else write_samples(read_telemetry(rows, format="csv").samples, form)
        running.process.forget_peak()
        with running.client() as api:
            begun = time.perf_counter()
            answer = api.post(PATH, content=body, headers={"Content-Type": kind}).raise_for_status().json()
            took_s = time.perf_counter() - begun
        what = f"L6 upload of {answer['samples']} rows ({form}, {len(body) / 1e6:.0f} MB) to flagged samples"
        yield Figure(ROOM, what, took_s, "s", "<= 5", took_s <= 5)
        peak = running.process.peak_mib()
        yield Figure(ROOM, f"{what}: memory", peak, "MiB", "<= 600", peak <= 600)


def _soak(running: Service, folder: Path) -> Iterator[Figure]:
    """Yield L9: a third of L1's rate for a while; memory, descriptors and the write-ahead log stay flat."""
    bodies, clients = Bodies(10_000), 8
    asyncio.run(together(running, clients, bodies, SOAK_S / 4, clients / 67))
    rss, files = running.process.rss_mib(), running.process.descriptors()
    seen = asyncio.run(together(running, clients, bodies, SOAK_S * 3 / 4, clients / 67))
    what, drift = f"L9 soak of {SOAK_S:g} s", 100 * (running.process.rss_mib() / rss - 1)
    note = f"{len(seen.accepted_s)} uploads, {dict(seen.statuses)}, {seen.resets} resets"
    yield Figure(ROOM, f"{what}: drift of memory", drift, "%", "<= 2", drift <= 2, note)
    leaked = running.process.descriptors() - files
    yield Figure(ROOM, f"{what}: further descriptors", leaked, "", "<= 2", abs(leaked) <= 2)
    log_mib = (folder / "data" / "magcal.db-wal").stat().st_size / 2**20
    yield Figure(ROOM, f"{what}: write-ahead log", log_mib, "MiB", "<= 256", log_mib <= 256)
    yield _kept(what, folder, seen)


async def _slow(running: Service) -> list[Figure]:
    """Return L10: a client that falls silent is cut, and so is one that keeps sending a byte a second."""
    connection = await asyncio.open_connection("127.0.0.1", running.port)
    reader, writer = connection
    headers = {"Content-Type": "text/csv", "Content-Length": "5000"}
    head = request_of("GET", PATH, running.key, headers).replace(b"GET", b"POST", 1)
    begun = time.perf_counter()
    writer.write(head + b"time,")
    answer = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 60)
    silent_s = time.perf_counter() - begun
    writer.close()
    with running.client() as api:
        free = api.post(PATH, content=Bodies(2000).next(), headers={"Content-Type": "text/csv"}).status_code
    is_met = answer.startswith(b"HTTP/1.1 408") and silent_s < 4 and free == 201
    note = f"{answer[9:12].decode()}; the next upload {free}; the limit is set to 3 s here, 30 s by default"
    figures = [Figure(ROOM, "L10 a client without progress is cut after", silent_s, "s", "408 at 3 s", is_met, note)]
    if CASE_S >= 60:
        figures.append(await _dripping(running, head))
    return figures


async def _dripping(running: Service, head: bytes) -> Figure:
    reader, writer = await asyncio.open_connection("127.0.0.1", running.port)
    begun, answer = time.perf_counter(), asyncio.ensure_future(reader.readuntil(b"\r\n\r\n"))
    writer.write(head)
    while not answer.done() and time.perf_counter() - begun < 120:
        writer.write(b"t")
        await asyncio.sleep(1.0)
    elapsed_s = time.perf_counter() - begun
    is_met = answer.done() and answer.result().startswith(b"HTTP/1.1 408")
    return Figure(ROOM, "L10 a client of one byte a second is cut after", elapsed_s, "s", "408 past 60 s", is_met)
