"""The first page of a fleet of 2,000 satellites with 200,000 sessions: its numbers, and the answer of a filter.

The service runs in a process over SQLite. ``MAGCAL_BENCH_SATELLITES`` sets another number of satellites; each
has a hundred sessions, an orbit and a parameter set in force.
"""

from __future__ import annotations

import os
import sqlite3
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import httpx2

from benchmarks.measure import Figure
from benchmarks.pages import service_over
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM: Final = "fleet"
SATELLITES: Final = 2000
SESSIONS_EACH: Final = 100
ROUNDS: Final = 7
PAGE_AIM_S: Final = 0.5
FILTER_AIM_S: Final = 0.2
PAUSE_S: Final = 6.0
"""Longer than what is known of a fleet is trusted."""
SEED: Final = "seed"

Row = Mapping[str, object]


def figures() -> Iterator[Figure]:
    """Yield the times of the first page and of filters."""
    satellites = int(os.environ.get("MAGCAL_BENCH_SATELLITES", SATELLITES))
    with tempfile.TemporaryDirectory(prefix="magcal-bench-") as folder:
        root = Path(folder)
        with service_over(root) as (url, key), _client(url, key) as client:
            _fill(client)
        _multiply(root / "data" / "magcal.db", satellites)
        with service_over(root) as (url, _), _client(url, key) as client:
            yield from _measured(client, satellites)


def _client(url: str, key: str) -> httpx2.Client:
    return httpx2.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=300.0)


def _fill(client: httpx2.Client) -> None:
    """Make one satellite whose newest set is in force, to be copied."""
    api = "/api/v1"
    client.post(f"{api}/satellites", json={"id": SEED, "name": "SEED"}).raise_for_status()
    client.post(f"{api}/satellites/{SEED}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    client.post(f"{api}/satellites/{SEED}/orbits", content=tle_text(), headers={"Content-Type": "text/plain"})
    body = write_samples(simulated(SESSIONS[0]).samples, "csv")
    path = f"{api}/satellites/{SEED}/sessions?magnetometer=mgm"
    sent = client.post(path, content=body, headers={"Content-Type": "text/csv"}).raise_for_status().json()
    job = (
        client.post(f"{api}/jobs", json={"kind": "calibration", "session_ids": [sent["id"]]}).raise_for_status().json()
    )
    while job["state"] in {"queued", "running"}:
        time.sleep(0.2)
        job = client.get(f"{api}/jobs/{job['id']}").json()
    client.post(f"{api}/parameter-sets/{job['result']['parameter_set_id']}/activate", json={}).raise_for_status()


def _multiply(database: Path, satellites: int) -> None:
    """Copy the satellite and all that is its own, its session a hundred times, under other names."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.row_factory = sqlite3.Row
        connection.execute("PRAGMA foreign_keys = OFF")
        of = {name: dict(connection.execute(f"SELECT * FROM {name}").fetchone()) for name in (  # noqa: S608
            "satellite", "magnetometer", "orbit", "session", "job", "parameter_set", "activation",
        )}  # fmt: skip
        copies: dict[str, list[Row]] = {name: [] for name in of}
        for number in range(1, satellites):
            name = f"sat-{number:05d}"
            own = {"satellite_id": name}
            set_id, job_id = f"{number:032x}", f"{number + (1 << 40):032x}"
            copies["satellite"].append(of["satellite"] | {"id": name, "name": f"SAT {number}"})
            copies["magnetometer"].append(of["magnetometer"] | own)
            copies["orbit"].append(of["orbit"] | own | {"id": f"{number + (1 << 41):032x}"})
            copies["job"].append(of["job"] | own | {"id": job_id})
            copies["parameter_set"].append(of["parameter_set"] | own | {"id": set_id, "job_id": job_id})
            copies["activation"].append({**of["activation"], **own, "id": number + 1000, "parameter_set_id": set_id})
            copies["session"] += [
                of["session"] | own | {"id": f"{number:016x}{one:016x}", "sha256": f"{number:032x}{one:032x}"}
                for one in range(SESSIONS_EACH)
            ]
        for name, rows in copies.items():
            _insert(connection, name, rows)
        connection.execute("ANALYZE")


def _insert(connection: sqlite3.Connection, table: str, rows: Sequence[Row]) -> None:
    names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})") if row[1] in rows[0]]
    columns, places = ", ".join(f'"{name}"' for name in names), ", ".join("?" for _ in names)
    values = ([row[name] for name in names] for row in rows)
    connection.executemany(f"INSERT INTO {table} ({columns}) VALUES ({places})", values)  # noqa: S608


def _measured(client: httpx2.Client, satellites: int) -> Iterator[Figure]:
    what = f"{satellites} satellites, {satellites * SESSIONS_EACH} sessions"
    first = _timed(client, "/")
    yield Figure(ROOM, f"first page, {what}: the first after a start", first, "s")
    # A write of anybody makes the next page look anew: that page, not one from the snapshot before, is what counts.
    anew, kept = [], []
    for number in range(ROUNDS):
        client.patch(f"/api/v1/satellites/{SEED}", json={"name": f"SEED {number}"}).raise_for_status()
        anew.append(_timed(client, "/"))
        kept.append(_timed(client, "/"))
    yield _figure(f"first page, {what}: after a change", anew, PAGE_AIM_S)
    yield _figure(f"first page, {what}: unchanged", kept, PAGE_AIM_S)
    time.sleep(PAUSE_S)
    idle = []
    for _ in range(3):
        time.sleep(PAUSE_S)
        idle.append(_timed(client, "/"))
    yield _figure(f"first page, {what}: after {PAUSE_S:g} s in which nobody asked", idle, PAGE_AIM_S)
    for name, query in (("a name", "q=sat-0123&limit=50"), ("a state", "state=watch&limit=50&sort=name")):
        filtered = []
        for number in range(ROUNDS):
            # A search that was not asked before: none is answered with what is at hand.
            filtered.append(_timed(client, f"/api/v1/fleet?{query}&cursor={number}"))
        yield _figure(f"fleet filtered by {name}, {what}", filtered, FILTER_AIM_S)


def _figure(what: str, times_s: Sequence[float], aim_s: float) -> Figure:
    median_s = statistics.median(times_s)
    return Figure(ROOM, what, median_s, "s", f"< {aim_s} s", median_s < aim_s, f"best {min(times_s):.3f} s")


def _timed(client: httpx2.Client, path: str) -> float:
    begin = time.perf_counter()
    answer = client.get(path).raise_for_status()
    elapsed = time.perf_counter() - begin
    if path == "/" and "data-answer" not in answer.text:
        raise RuntimeError("the first page has brought no numbers along")
    return elapsed
