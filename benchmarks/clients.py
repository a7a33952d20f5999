"""Clients that upload at once, what they saw, and whether the store has what was acknowledged to them."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from sqlalchemy import select

from app.sessions.tables import Chunk
from app.settings import Settings
from app.storage.database import Database
from app.storage.open_store import open_store
from app.storage.store import raw_key
from benchmarks.service import Service, length_of, request_of
from magcal_core.simulation.dekart_mission import tle_text

PATH: Final = "/satellites/load/sessions?magnetometer=mgm"
NUMBERS: Final = itertools.count()
RETRY_AFTER_S: Final = 1.0
"""What refusals say, and clients do."""


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


def prepare_load(running: Service) -> None:
    """Register the satellite, the magnetometer and the orbit that clients send telemetry of."""
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


async def ask(
    connection: tuple[asyncio.StreamReader, asyncio.StreamWriter], request: bytes
) -> tuple[int, bytes, bytes]:
    """Return status, head and body of the answer to ``request``."""
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
            status, head, _ = await ask(connection, request)
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


async def together(
    services: Sequence[Service], clients: int, bodies: Bodies, duration_s: float, pause_s: float = 0.0
) -> Seen:
    """Return what clients saw that uploaded at once, each to one of ``services`` in turn."""
    seen, until = Seen(), time.monotonic() + duration_s
    turns = itertools.islice(itertools.cycle(services), clients)
    await asyncio.gather(*(_uploading(one, bodies, seen, until, pause_s) for one in turns))
    return seen


def lost_of(folder: Path, sha256: Sequence[str], database_url: str | None = None) -> int:
    """Return how many acknowledged bodies the store over the data folder ``folder``/data does not give back."""
    settings = Settings(data_dir=folder / "data", database_url=database_url)
    database, store, lost = Database(settings), open_store(settings), 0
    for one in sha256:
        with database.read() as session:
            known = session.scalar(select(Chunk.sha256).where(Chunk.sha256 == one).limit(1))
            content = b"" if known is None else store.get(session, raw_key("load", one), one)
        lost += int(hashlib.sha256(content).hexdigest() != one)
    database.close()
    return lost


def p99_of(durations_s: Sequence[float]) -> float:
    """Return the 99th percentile of durations, s; NaN where there are none."""
    return float(np.quantile(durations_s, 0.99)) if durations_s else float("nan")
