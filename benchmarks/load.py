"""L1 to L6, L9 and L10: clients against a real server on the same machine, and every acknowledged body read back.

Each case takes ``MAGCAL_BENCH_LOAD_S`` seconds (default 10), the soak ``MAGCAL_BENCH_SOAK_S`` (default 120). The
clients share the machine's cores with the server. What was acknowledged is looked for in the database afterwards,
byte for byte, so that "lost" is a figure and not a hope. L1 and L2 are measured three times: with one server over the
embedded database, with one over PostgreSQL, and with the clients spread over two servers of one PostgreSQL.
"""

from __future__ import annotations

import asyncio
import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.clients import PATH, Bodies, Seen, ask, lost_of, p99_of, prepare_load, together
from benchmarks.measure import Figure
from benchmarks.service import LeanClient, Service, cpu_s_of, postgres, request_of, scratch, service
from magcal_core.telemetry import read_telemetry, write_samples

ROOM: Final = "load"
CASE_S: Final = float(os.environ.get("MAGCAL_BENCH_LOAD_S", "10"))
SOAK_S: Final = float(os.environ.get("MAGCAL_BENCH_SOAK_S", "120"))
POLLERS: Final = 50
LIMITS: Final = {"MIN_FREE_MB": "0", "MAX_UPLOADS_PER_KEY": "64", "MAX_UPLOAD_MB": "200", "MAX_ROWS": "3000000"}


@dataclass(frozen=True, slots=True)
class Case:
    """Many clients with bodies of one size, and what their uploads should reach."""

    name: str
    clients: int
    size_bytes: int
    rate_aim: float
    p99_aim: float | None

    @property
    def what(self) -> str:
        """The case as the figures name it."""
        return f"{self.name} {self.clients} clients, {self.size_bytes / 1e3:.0f} kB"


SHORT: Final = Case("L1", 32, 10_000, 200.0, 0.75)
MIDDLE: Final = Case("L2", 32, 1_000_000, 120.0, 1.0)
LONG: Final = Case("L3", 16, 10_000_000, 8.5, None)


@dataclass(frozen=True, slots=True)
class Site:
    """Servers over one database; ``where`` is what the figures say of them."""

    folder: Path
    services: Sequence[Service]
    database_url: str | None = None
    where: str = ""

    def servers_cpu_s(self) -> float:
        """Return the processor time of the servers, s."""
        return sum(one.process.cpu_s() for one in self.services)

    def database_cpu_s(self) -> float:
        """Return the processor time of the database's own processes, s; none where it is embedded."""
        if self.database_url is None:
            return 0.0
        return sum(cpu_s_of([int((self.folder / "pg" / "postmaster.pid").read_text().split()[0])]))

    def rss_mib(self) -> float:
        """Return the servers' resident memory, MiB."""
        return sum(one.process.rss_mib() for one in self.services)

    def kept(self, what: str, seen: Seen) -> Figure:
        """Return how much of what was acknowledged is lost."""
        lost = lost_of(self.folder, seen.sha256, self.database_url)
        return Figure(ROOM, f"{what}, acknowledged and lost", lost, f"of {len(seen.sha256)}", "0", lost == 0)


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder, service(folder, "--workers", "0", **LIMITS) as running:
        prepare_load(running)
        site = Site(folder, [running])
        for case in (SHORT, MIDDLE, LONG):
            yield from _sizes(site, case)
        yield from _crowds(site)
        yield from _polling(running, site)
        yield from _soak(running, site)
    yield from _on_postgres()
    with scratch() as folder, service(folder, "--workers", "1", **LIMITS) as running:
        prepare_load(running)
        yield from _long_session(running)
    with scratch() as folder, service(folder, "--workers", "0", UPLOAD_STALL_S="3", **LIMITS) as running:
        prepare_load(running)
        yield from asyncio.run(_slow(running))


def _on_postgres() -> Iterator[Figure]:
    """Yield L1 and L2 with one server and with two over one PostgreSQL."""
    with scratch() as folder, postgres(folder) as url:
        options = ("--workers", "0")
        with (
            service(folder, *options, DATABASE_URL=url, **LIMITS) as first,
            service(folder, *options, DATABASE_URL=url, **LIMITS) as second,
        ):
            prepare_load(first)
            one = Site(folder, [first], url, ", PostgreSQL")
            two = Site(folder, [first, second], url, ", two servers over PostgreSQL")
            for case in (SHORT, MIDDLE):
                yield from _sizes(one, case)
                yield from _sizes(two, case)


def _sizes(site: Site, case: Case) -> Iterator[Figure]:
    """Yield L1, L2 or L3: the rate, and the p99 or the growth of memory."""
    bodies, what = Bodies(case.size_bytes), case.what + site.where
    asyncio.run(together(site.services, case.clients, bodies, 1.0))
    rss_mib, begun = site.rss_mib(), time.perf_counter()
    before = site.servers_cpu_s(), site.database_cpu_s(), time.process_time()
    seen = asyncio.run(together(site.services, case.clients, bodies, CASE_S))
    rate, count = len(seen.accepted_s) / (time.perf_counter() - begun), max(1, len(seen.accepted_s))
    after = site.servers_cpu_s(), site.database_cpu_s(), time.process_time()
    server_ms, database_ms, client_ms = (1e3 * (now - then) / count for now, then in zip(after, before, strict=True))
    note = f"each {server_ms:.1f} ms of the server's processor, {client_ms:.1f} ms of the clients'"
    note += f", {database_ms:.1f} ms of the database's" if site.database_url else ""
    yield Figure(
        ROOM, what, rate, "1/s", f">= {case.rate_aim:g}", rate >= case.rate_aim, f"{note}; {dict(seen.statuses)}"
    )
    if case.p99_aim is not None:
        p99 = p99_of(seen.accepted_s)
        yield Figure(ROOM, f"{what}, p99", p99, "s", f"<= {case.p99_aim:g}", p99 <= case.p99_aim)
    else:
        growth = site.rss_mib() - rss_mib
        yield Figure(ROOM, f"{what}, growth of memory", growth, "MiB", "<= 64", growth <= 64)
    yield site.kept(what, seen)


def _crowds(site: Site) -> Iterator[Figure]:
    """Yield L4: 200, then 1000 clients at once."""
    for clients in (200, 1000):
        seen = asyncio.run(together(site.services, clients, Bodies(10_000), CASE_S))
        what, odd = f"L4 {clients} clients at once", seen.resets + seen.unexplained
        note = f"{dict(seen.statuses)}, {seen.resets} resets"
        yield Figure(ROOM, f"{what}: resets, and refusals without Retry-After", odd, "", "0", odd == 0, note)
        accepted = p99_of(seen.accepted_s)
        yield Figure(ROOM, f"{what}: accepted, p99", accepted, "s", "<= 5", accepted <= 5)
        refused = statistics.median(seen.refused_s) if seen.refused_s else 0.0
        note = f"p99 {p99_of(seen.refused_s):.2f} s, of {len(seen.refused_s)}"
        yield Figure(ROOM, f"{what}: refused, median", refused, "s", "<= 0.1", refused <= 0.1, note)
        yield site.kept(what, seen)


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
            await ask(connection, poll)
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


def _polling(running: Service, site: Site) -> Iterator[Figure]:
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
    yield site.kept(what, seen)


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


def _soak(running: Service, site: Site) -> Iterator[Figure]:
    """Yield L9: a third of L1's rate for a while; memory, descriptors and the write-ahead log stay flat."""
    bodies, clients = Bodies(10_000), 8
    asyncio.run(together([running], clients, bodies, SOAK_S / 4, clients / 67))
    rss, files = running.process.rss_mib(), running.process.descriptors()
    seen = asyncio.run(together([running], clients, bodies, SOAK_S * 3 / 4, clients / 67))
    what, drift = f"L9 soak of {SOAK_S:g} s", 100 * (running.process.rss_mib() / rss - 1)
    note = f"{len(seen.accepted_s)} uploads, {dict(seen.statuses)}, {seen.resets} resets"
    yield Figure(ROOM, f"{what}: drift of memory", drift, "%", "<= 2", drift <= 2, note)
    leaked = running.process.descriptors() - files
    yield Figure(ROOM, f"{what}: further descriptors", leaked, "", "<= 2", abs(leaked) <= 2)
    log_mib = (site.folder / "data" / "magcal.db-wal").stat().st_size / 2**20
    yield Figure(ROOM, f"{what}: write-ahead log", log_mib, "MiB", "<= 256", log_mib <= 256)
    yield site.kept(what, seen)


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
