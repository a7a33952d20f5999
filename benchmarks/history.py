"""Growth: what lists, times and uploads cost against the number of sessions and parameter sets in the history.

``MAGCAL_BENCH_HISTORY`` is the largest number (default 1,000,000). Rows are planted with SQL as the service writes
them; the records of the planted sets are short, since their length is the same at every number.
"""

from __future__ import annotations

import base64
import json
import math
import os
import sqlite3
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

import httpx2

from benchmarks.measure import Figure
from benchmarks.service import LeanClient, Service, request_of, scratch, service
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM: Final = "history"
SATELLITE: Final = "bench"
LARGEST: Final = int(os.environ.get("MAGCAL_BENCH_HISTORY", "1000000"))
ROUNDS: Final = 60
UPLOADS: Final = 15
GROWTH_AIM: Final = 2.0
EPOCH: Final = datetime(2000, 1, 1)  # noqa: DTZ001  SQLite keeps UTC without its zone
SPAN: Final = timedelta(minutes=10)
RECORD: Final = '{"status": "candidate", "verdict": {"grade": "accept", "reasons": []}, "warnings": []}'
NUMBERS: Final = "WITH RECURSIVE n(i) AS (SELECT :first UNION ALL SELECT i + 1 FROM n WHERE i + 1 < :last)"
TIME: Final = "strftime('%Y-%m-%d %H:%M:%S', :epoch, (i * 10) || ' minutes') || '.000000'"
NEXT: Final = "strftime('%Y-%m-%d %H:%M:%S', :epoch, (i * 10 + 10) || ' minutes') || '.000000'"
PLANTED: Final = {
    "session": {"id": "printf('%032x', i)", "sha256": "printf('%064x', i)", "data_from": TIME, "data_until": NEXT},
    "job": {"id": "printf('%032x', i)"},
    "parameter_set": {
        "id": "printf('%032x', i)",
        "job_id": "printf('%032x', i)",
        "status": "'retired'",
        "record": ":record",
        "data_from": TIME,
        "data_until": NEXT,
    },
    "parameter_set_session": {"parameter_set_id": "printf('%032x', i)", "session_id": "printf('%032x', i)"},
}
"""Table -> what differs from the row that the service made."""
ACTIVATIONS: Final = f"""{NUMBERS} INSERT INTO activation
(id, satellite_id, magnetometer_id, parameter_set_id, previous_id, begun_at, ended_at, begun_by)
SELECT printf('%032x', i), '{SATELLITE}', 'mgm', printf('%032x', i), NULL, {TIME}, {NEXT}, NULL FROM n"""  # noqa: S608


Cost = tuple[float, float]
"""Median time to the answer and the server's processor time, ms."""


def first_set(api: httpx2.Client) -> dict[str, str]:
    """Make a satellite with one calibrated session of 700 samples; return the ids of session, job and parameter set."""
    api.post("/satellites", json={"id": SATELLITE}).raise_for_status()
    api.post(f"/satellites/{SATELLITE}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    plain = {"Content-Type": "text/plain"}
    api.post(f"/satellites/{SATELLITE}/orbits", content=tle_text(), headers=plain).raise_for_status()
    body = write_samples(simulated(SESSIONS[0]).samples, "csv")
    where = f"/satellites/{SATELLITE}/sessions?magnetometer=mgm"
    session = api.post(where, content=body, headers={"Content-Type": "text/csv"}).raise_for_status().json()
    job = calibrated(api, session["id"])
    return {"session": session["id"], "job": job["id"], "set": job["result"]["parameter_set_id"]}


def calibrated(api: httpx2.Client, session_id: str) -> dict[str, dict[str, str]]:
    """Return the job that has calibrated a session."""
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id]}).raise_for_status().json()
    while job["state"] in {"queued", "running"}:
        time.sleep(0.005)
        job = api.get(f"/jobs/{job['id']}").json()
    if job["state"] != "succeeded":
        raise RuntimeError(str(job["error"]))
    return dict(job)


def plant(database: Path, first: int, last: int, record: str = RECORD) -> None:
    """Plant sessions, jobs, parameter sets and activations ``first`` to ``last`` after the pattern of what is there."""
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.row_factory = sqlite3.Row
        values = {"first": first, "last": last, "epoch": EPOCH.isoformat(sep=" "), "record": record}
        for table, own in PLANTED.items():
            newest = "parameter_set_id" if table == "parameter_set_session" else "id"
            one = connection.execute(f"SELECT * FROM {table} ORDER BY {newest} DESC LIMIT 1").fetchone()  # noqa: S608
            same = {name: one[name] for name in one.keys() if name not in own}  # noqa: SIM118  rows of sqlite3
            columns = ", ".join(f'"{name}"' for name in (*own, *same))
            given = ", ".join((*own.values(), *(f":_{name}" for name in same)))
            bound = values | {f"_{name}": value for name, value in same.items()}
            connection.execute(f"{NUMBERS} INSERT INTO {table} ({columns}) SELECT {given} FROM n", bound)  # noqa: S608
        connection.execute(ACTIVATIONS, values)
        connection.execute("ANALYZE")


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder:
        found: dict[str, dict[int, Cost]] = {}
        with service(folder, "--workers", "1") as running, running.client() as api:
            first_set(api)
        before, count = 1, 100
        while count <= LARGEST:
            plant(folder / "data" / "magcal.db", before, count)
            with service(folder, "--workers", "0") as running:
                for what, (duration_ms, cpu_ms) in _looks(running, count):
                    found.setdefault(what, {})[count] = duration_ms, cpu_ms
                    note = f"{cpu_ms:.1f} ms of the server's processor each"
                    yield Figure(ROOM, f"{what}, {count} sessions", duration_ms, "ms", note=note)
            before, count = count, count * 10
        for what, durations in found.items():
            ratio, cpu_ratio = (durations[max(durations)][i] / durations[min(durations)][i] for i in (0, 1))
            span = f"{max(durations)} against {min(durations)} sessions"
            is_met = ratio <= GROWTH_AIM
            note = f"of the server's processor time {cpu_ratio:.2f} times"
            yield Figure(ROOM, f"growth of {what}: {span}", ratio, "times", f"<= {GROWTH_AIM:g}", is_met, note)


def _looks(running: Service, count: int) -> Iterator[tuple[str, Cost]]:
    """Yield what was asked for, the median time to its answer, ms, and the server's processor time of each, ms."""
    client = LeanClient(running.port)
    sets, where = "/parameter-sets", f"satellite={SATELLITE}"

    def another(path: str) -> Callable[[int], bytes]:
        return lambda turn: request_of("GET", f"{path}&limit=50&until=2099-01-01T00:00:{turn:02d}Z", running.key)

    def at(turn: int) -> bytes:
        time_utc = EPOCH + SPAN * (1 + turn * 7919 % (count - 1)) + timedelta(seconds=30)
        return request_of("GET", f"{sets}?{where}&at={time_utc:%Y-%m-%dT%H:%M:%SZ}", running.key)

    def newest_jobs(_turn: int) -> bytes:
        return request_of("GET", "/jobs?state=succeeded&limit=50", running.key)

    asked = {
        "newest 50 sets": another(f"{sets}?{where}"),
        "50 sets from the middle by cursor": another(f"{sets}?{where}&cursor={_cursor(count)}"),
        "set in force at a time": at,
        "newest 50 sessions": another(f"/sessions?{where}"),
        "newest 50 jobs of a state": newest_jobs,
    }
    for what, request in asked.items():
        durations, cpu_s = [], running.process.cpu_s()
        for turn in range(ROUNDS):
            begun = time.perf_counter()
            status, _, body = client.ask(request(turn))
            durations.append(1e3 * (time.perf_counter() - begun))
            if status != 200 or (what == "set in force at a time" and body.count(b'"status":') != 1):
                raise RuntimeError(f"{what}: {status} {body[:300]!r}")
        yield what, (statistics.median(durations), 1e3 * (running.process.cpu_s() - cpu_s) / ROUNDS)
    cpu_s = running.process.cpu_s()
    upload_ms = _uploads_ms(client, running, count)
    yield "upload of 700 samples", (upload_ms, 1e3 * (running.process.cpu_s() - cpu_s) / UPLOADS)
    client.close()


def _cursor(count: int) -> str:
    """Return the cursor of what follows the set in the middle."""
    text = json.dumps([f"{count // 2:032x}"]).encode()
    return base64.urlsafe_b64encode(text).decode().rstrip("=")


def _uploads_ms(client: LeanClient, running: Service, count: int) -> float:
    whole = write_samples(simulated(SESSIONS[0]).samples, "csv")
    path, kind = f"/satellites/{SATELLITE}/sessions?magnetometer=mgm", {"Content-Type": "text/csv"}
    durations = []
    for turn in range(UPLOADS):
        body = whole + b"\n" * (1 + turn + UPLOADS * round(math.log10(count)))
        begun = time.perf_counter()
        status, _, answer = client.ask(request_of("POST", path, running.key, kind, body))
        durations.append(1e3 * (time.perf_counter() - begun))
        if status != 201:
            raise RuntimeError(answer.decode())
    return statistics.median(durations)
