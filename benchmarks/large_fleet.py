"""Growth of the service over PostgreSQL: 10,000 satellites, what is asked of them, and what upkeep takes.

``MAGCAL_BENCH_FLEET`` satellites (default 10,000) with ``MAGCAL_BENCH_FLEET_SESSIONS`` sessions each (default 50; 500
for the long run, which takes 10 GB of disk) and a tenth as many parameter sets, of one row that the service made, with
short telemetry. One server answers without workers. Each figure is what passed, median of `ROUNDS`; its note has the
processor time of the server and of PostgreSQL.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import httpx2
import psycopg

from app.maintenance.audit import audit
from app.maintenance.retention import expired
from app.settings import Settings
from app.storage.database import Database
from app.storage.open_store import open_store
from app.storage.store import Store
from benchmarks.history import calibrated
from benchmarks.measure import Figure
from benchmarks.planted import SEED, plant
from benchmarks.service import LeanClient, Service, cpu_s_of, postgres, process, request_of, scratch, service
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM: Final = "large_fleet"
IS_STUDY: Final = True
SATELLITES: Final = int(os.environ.get("MAGCAL_BENCH_FLEET", "10000"))
EACH: Final = int(os.environ.get("MAGCAL_BENCH_FLEET_SESSIONS", "50"))
ROUNDS: Final = 7
AUDITED: Final = 200
"""Sessions whose objects are there too, for the audit, before the others are planted."""
SETTLED_S: Final = 120.0

Asking = tuple[Callable[[int], str], Callable[[int], None] | None]
"""Path of a turn, and what is done before it."""


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    sets = max(EACH // 10, 1)
    with scratch() as folder, postgres(folder) as url:
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute("ALTER SYSTEM SET max_wal_size = '8GB'")
            connection.execute("SELECT pg_reload_conf()")
        work = {"MAGCAL_DATABASE_URL": url, "MAGCAL_DATA_DIR": str(folder / "data")}
        with service(folder, DATABASE_URL=url, MIN_FREE_MB="0") as running, running.client() as api:
            with process(folder, work, "worker", "--concurrency", "1"):
                _first(api)
            _send_many(api, AUDITED)
        yield from _audit(folder, url)
        begun = time.perf_counter()
        plant(url, SATELLITES, EACH, sets)
        took_s = time.perf_counter() - begun
        what = f"{SATELLITES} satellites of {EACH} sessions and {sets} sets"
        yield Figure(ROOM, f"rows of {what} made", took_s, "s", note=f"{_size_gb(url):.1f} GB of database")
        with service(folder, DATABASE_URL=url, MIN_FREE_MB="0") as running:
            yield from _answers(running, _postmaster(folder))
        yield from _upkeep(folder, url)


def _first(api: httpx2.Client) -> None:
    """Make one satellite with one calibrated session, its set in force."""
    api.post("/satellites", json={"id": SEED}).raise_for_status()
    api.post(f"/satellites/{SEED}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    plain = {"Content-Type": "text/plain"}
    api.post(f"/satellites/{SEED}/orbits", content=tle_text(), headers=plain).raise_for_status()
    sent = _send(api, write_samples(simulated(SESSIONS[0]).samples, "csv"))
    job = calibrated(api, sent["id"])
    api.post(f"/parameter-sets/{job['result']['parameter_set_id']}/activate", json={}).raise_for_status()


def _send(api: httpx2.Client, body: bytes) -> dict[str, str]:
    path = f"/satellites/{SEED}/sessions?magnetometer=mgm"
    return dict(api.post(path, content=body, headers={"Content-Type": "text/csv"}).raise_for_status().json())


def _send_many(api: httpx2.Client, count: int) -> None:
    body = write_samples(simulated(SESSIONS[0]).samples, "csv")
    for number in range(count):
        _send(api, body + b"\n" * (number + 1))


def _audit(folder: Path, url: str) -> Iterator[Figure]:
    database, store = _opened(folder, url)
    begun, cpu_s = time.perf_counter(), time.process_time()
    found = audit(database, store)
    took_s, cpu_s = time.perf_counter() - begun, time.process_time() - cpu_s
    if found.findings:
        raise RuntimeError(str(found.findings[:3]))
    database.close()
    note = f"{found.sessions} sessions, {found.objects} objects; {1e3 * cpu_s / found.sessions:.2f} ms of its processor"
    yield Figure(ROOM, "audit, for each session of 700 samples, byte for byte", 1e3 * took_s / found.sessions, "ms",
                 note=note)  # fmt: skip


def _opened(folder: Path, url: str) -> tuple[Database, Store]:
    settings = Settings(data_dir=folder / "data", database_url=url)
    return Database(settings), open_store(settings)


def _size_gb(url: str) -> float:
    with psycopg.connect(url) as connection:
        found = connection.execute("SELECT pg_database_size(current_database())").fetchone()
    return float(found[0]) / 1e9 if found else 0.0


def _postmaster(folder: Path) -> int:
    return int((folder / "pg" / "postmaster.pid").read_text().split()[0])


def _answers(running: Service, postmaster: int) -> Iterator[Figure]:
    """Yield what passes until each answer is there, with the processor time of server and database."""
    begun = time.perf_counter()
    _ask(LeanClient(running.port), running, "/api/v1/fleet")
    yield Figure(ROOM, "the fleet, the first after a start", time.perf_counter() - begun, "s")
    yield _settled(running)
    some = "sat-000777" if SATELLITES > 777 else "sat-000000"
    now = datetime.now(UTC)

    def change(turn: int) -> None:
        with running.client() as api:
            api.patch(f"/satellites/{some}", json={"name": f"Renamed {turn}"}).raise_for_status()

    def at(turn: int) -> str:
        when = now - timedelta(hours=6 * EACH * (turn + 1) / (ROUNDS + 1))
        return f"at={when:%Y-%m-%dT%H:%M:%SZ}"

    asked: dict[str, Asking] = {
        "first page, after a change": (lambda _turn: "/", change),
        "first page, unchanged": (lambda _turn: "/", None),
        "fleet filtered by a name": (lambda turn: f"/api/v1/fleet?q=sat-0012&cursor={turn}", None),
        "fleet filtered by a state": (lambda turn: f"/api/v1/fleet?state=watch&sort=name&cursor={turn}", None),
        "attention, 100 entries": (lambda turn: f"/api/v1/attention?limit={100 - turn}&total=true", None),
        "overview, 100 satellites": (lambda turn: f"/api/v1/overview?limit={100 - turn}", None),
        "history of a satellite, 50 sets": (
            lambda turn: f"/api/v1/satellites/{some}/history?limit={50 - turn}", None,
        ),
        "set in force of a satellite at a time": (
            lambda turn: f"/api/v1/parameter-sets?satellite={some}&{at(turn)}", None,
        ),
        "sets in force of all at a time, 100 of them": (
            lambda turn: f"/api/v1/parameter-sets?view=summary&{at(turn)}", None,
        ),
        "sessions of a satellite, 50": (lambda turn: f"/api/v1/sessions?satellite={some}&limit={50 - turn}", None),
        "sessions of all, 50": (lambda turn: f"/api/v1/sessions?limit={50 - turn}", None),
        "jobs that failed, 50": (lambda turn: f"/api/v1/jobs?state=failed&limit={50 - turn}", None),
    }  # fmt: skip
    for what, asking in asked.items():
        yield _figure(running, postmaster, what, asking)
    yield Figure(ROOM, "memory of the server, resident", running.process.rss_mib(), "MiB",
                 note=f"{running.process.peak_mib():.0f} MiB at most")  # fmt: skip


def _figure(running: Service, postmaster: int, what: str, asking: Asking) -> Figure:
    client, (path, before) = LeanClient(running.port), asking
    durations, used = [], [0.0, 0.0]
    for turn in range(ROUNDS):
        if before is not None:
            before(turn)
        server_s, database_s = running.process.cpu_s(), sum(cpu_s_of([postmaster]))
        begun = time.perf_counter()
        _ask(client, running, path(turn))
        durations.append(time.perf_counter() - begun)
        used[0] += running.process.cpu_s() - server_s
        used[1] += sum(cpu_s_of([postmaster])) - database_s
    client.close()
    server_ms, database_ms = (1e3 * one / ROUNDS for one in used)
    note = f"processor {server_ms:.0f} + {database_ms:.0f} ms; best {1e3 * min(durations):.0f} ms"
    return Figure(ROOM, what, 1e3 * statistics.median(durations), "ms", note=note)


def _ask(client: LeanClient, running: Service, path: str) -> bytes:
    request = request_of("GET", path, running.key).replace(b"GET /api/v1/", b"GET /", 1)
    status, _, body = client.ask(request)
    if status != 200:
        raise RuntimeError(f"{path}: {status} {body[:300]!r}")
    return body


def _settled(running: Service) -> Figure:
    """Return how long the server is at work by itself after its start: the log is told of what needs attention."""
    begun = time.perf_counter()
    while time.perf_counter() - begun < SETTLED_S:
        before = running.process.cpu_s()
        time.sleep(2.0)
        if running.process.cpu_s() - before < 0.2:
            break
    return Figure(ROOM, "until the server is at rest after its start", time.perf_counter() - begun, "s")


def _upkeep(folder: Path, url: str) -> Iterator[Figure]:
    database, _ = _opened(folder, url)
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("UPDATE satellite SET retention_days = 3650")
    begun, cpu_s = time.perf_counter(), time.process_time()
    found = expired(database)
    took_s, cpu_s = time.perf_counter() - begun, time.process_time() - cpu_s
    note = f"{len(found)} sessions are past it; {cpu_s:.2f} s of its processor"
    yield Figure(ROOM, "retention, a look at all satellites", took_s, "s", note=note)
    database.close()
    pg_dump = Path(f"/proc/{_postmaster(folder)}/exe").readlink().with_name("pg_dump")
    begun = time.perf_counter()
    with (folder / "dump").open("wb") as dump:
        subprocess.run([pg_dump, "--format=custom", "--compress=1", "--dbname", url.replace("+psycopg", "")],
                       stdout=dump, check=True)  # fmt: skip
    size_gb = (folder / "dump").stat().st_size / 1e9
    yield Figure(ROOM, "backup (pg_dump)", time.perf_counter() - begun, "s", note=f"{size_gb:.2f} GB")
