"""The API over a history of 1,000 whole parameter sets: lists, entity tags, from an upload to its result, refits."""

from __future__ import annotations

import json
import sqlite3
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

import httpx2
import numpy as np

from app.access.caller import SYSTEM
from app.http.schemas import Page
from app.parameter_sets.json_listing import Texts, listed, part
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.schemas import ParameterSetQuery, ParameterSetRead
from app.settings import Settings
from app.storage.database import Database
from benchmarks.history import SATELLITE, calibrated, first_set, plant
from benchmarks.measure import Figure, interleaved_s
from benchmarks.pipeline import telemetry
from benchmarks.service import LeanClient, Service, request_of, scratch, service
from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples

ROOM: Final = "api"
SETS: Final = 1000
PARQUET: Final = "application/vnd.apache.parquet"
RESULTS: Final = 9
RESULT_AIM_S: Final = 0.5
REFITS: Final = 60
REFIT_SAMPLES: Final = 100_000
REFIT_AIM_MS: Final = 10.0
COLUMNS: Final = 6
LISTS: Final = f"/parameter-sets?satellite={SATELLITE}"


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder:
        with service(folder) as running, running.client() as api:
            first_set(api)
            yield _result(running)
        database = folder / "data" / "magcal.db"
        with closing(sqlite3.connect(database)) as connection:
            record = connection.execute("SELECT record FROM parameter_set LIMIT 1").fetchone()[0]
            count = connection.execute("SELECT count(*) FROM parameter_set").fetchone()[0]
        plant(database, 1, SETS - count + 1, record)
        yield _against_models(folder)
        with service(folder, "--workers", "0") as running:
            yield from _lists(running)
    with scratch() as folder, service(folder) as running:
        yield from _refits(running)


def _result(running: Service) -> Figure:
    """Return the time from the first byte of an upload of 700 samples to the parameter set of its calibration."""
    whole = write_samples(simulated(SESSIONS[0]).samples, "csv")
    durations = []
    with running.client() as api:
        for turn in range(RESULTS):
            begun = time.perf_counter()
            where, kind = f"/satellites/{SATELLITE}/sessions?magnetometer=mgm", {"Content-Type": "text/csv"}
            session = api.post(where, content=whole + b"\n" * (turn + 1), headers=kind).raise_for_status().json()
            job = calibrated(api, session["id"])
            api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").raise_for_status()
            durations.append(time.perf_counter() - begun)
    median = statistics.median(durations)
    what = "POST of 700 samples to its parameter set, embedded"
    return Figure(
        ROOM, what, median, "s", f"<= {RESULT_AIM_S:g}", median <= RESULT_AIM_S, f"worst {max(durations):.2f}"
    )


def _refits(running: Service) -> Iterator[Figure]:
    """Yield the time to the answer of refits of a session without columns and of one with some, over HTTP."""
    with running.client() as api:
        first_set(api)
        bare, full = (_long_set(api, columns) for columns in (0, COLUMNS))
    what = "refit of a 1e5-sample session from its stored moments"
    yield _refit(running, f"{what}, over HTTP", bare, "", REFIT_AIM_MS)
    yield _refit(running, f"{what}, with 200 bootstrap replicates", bare, "&bootstrap=200")
    yield _refit(running, f"{what}, {COLUMNS} columns kept", full, "")
    yield _refit(running, f"{what}, regressors chosen among {COLUMNS}", full, "&regressors=auto")


def _long_set(api: httpx2.Client, columns: int) -> str:
    """Return the parameter set of a session with so many columns that say nothing."""
    random = np.random.default_rng(columns)
    keeping = {f"column {i}": np.cumsum(random.normal(size=REFIT_SAMPLES)) for i in range(columns)}
    samples = replace(telemetry(REFIT_SAMPLES, 1.0), housekeeping=keeping)
    where, kind = f"/satellites/{SATELLITE}/sessions?magnetometer=mgm", {"Content-Type": PARQUET}
    sent = api.post(where, content=write_samples(samples, "parquet"), headers=kind).raise_for_status().json()
    return calibrated(api, sent["id"])["result"]["parameter_set_id"]


def _refit(running: Service, what: str, set_id: str, query: str, aim_ms: float | None = None) -> Figure:
    """Return the median time to the answer, ms; another span is left out each time."""
    client, durations = LeanClient(running.port), []
    requests = [
        request_of(
            "GET",
            f"/parameter-sets/{set_id}/refit?without=2022-02-20T00:00:00Z/2022-02-20T01:00:{turn:02d}Z{query}",
            running.key,
        )
        for turn in range(REFITS)
    ]
    client.ask(requests[0])
    cpu_s = running.process.cpu_s()
    for request in requests:
        begun = time.perf_counter()
        status, _, body = client.ask(request)
        durations.append(1e3 * (time.perf_counter() - begun))
        if status != 200:
            raise RuntimeError(f"{status}: {body[:300]!r}")
    client.close()
    median, cpu_ms = statistics.median(durations), 1e3 * (running.process.cpu_s() - cpu_s) / REFITS
    aim, is_met = (f"<= {aim_ms:g}", median <= aim_ms) if aim_ms else ("", None)
    note = f"{cpu_ms:.1f} ms of the server's processor each, worst {max(durations):.0f} ms"
    return Figure(ROOM, what, median, "ms", aim, is_met, note)


def _against_models(folder: Path) -> Figure:
    """Return how many times the list is written faster than through rows, response models and back, without HTTP."""
    database = Database(Settings(data_dir=folder / "data"))
    query = ParameterSetQuery(satellite=SATELLITE, limit=SETS)

    def models() -> object:
        with database.read() as session:
            sets = ParameterSetRepository(session, SYSTEM)
            rows, cursor, total = sets.page(query)
            return Page[ParameterSetRead](items=sets.read(rows), next=cursor, total=total).model_dump_json()

    def texts() -> object:
        with database.engine.connect() as connection:
            wanted = listed(connection, SYSTEM, query)
            return part(Texts().of(connection, wanted.sets), wanted)

    took = interleaved_s({"models": models, "texts": texts}, rounds=5)
    database.close()
    ratio = took["models"] / took["texts"]
    note = f"{1e3 * took['texts']:.1f} ms, nothing at hand before"
    return Figure(ROOM, f"history of {SETS} against rows and response models", ratio, "times", ">= 4", ratio >= 4, note)


def _lists(running: Service) -> Iterator[Figure]:
    client = LeanClient(running.port)
    _, head, body = client.ask(request_of("GET", f"{LISTS}&limit=1", running.key))
    cursors = _cursors(client, running)

    def same(path: str) -> Callable[[int], bytes]:
        return lambda _turn: request_of("GET", path, running.key)

    def known(path: str) -> Callable[[int], bytes]:
        tag = _tag(client.ask(request_of("GET", path, running.key))[1])
        request = request_of("GET", path, running.key, {"If-None-Match": tag})
        return lambda _turn: request

    whole, page = f"{LISTS}&limit={SETS}", f"{LISTS}&limit=50"
    asked = (
        (f"history of {SETS} whole sets", same(whole), 60, 100.0, 200),
        ("page of 50, the same again", same(page), 2000, 1000.0, 200),
        ("page of 50, another each time", lambda turn: same(f"{page}&cursor={cursors[turn]}")(turn), 400, None, 200),
        (f"history of {SETS} by its tag (304)", known(whole), 8000, 4000.0, 304),
        ("page of 50 by its tag (304)", known(page), 8000, 4000.0, 304),
        ("one parameter set", same(f"/parameter-sets/{json.loads(body)['items'][0]['id']}"), 1000, None, 200),
    )
    for what, request, count, aim, status in asked:
        rate, cpu_ms, size = _rate(client, running, request, count, status)
        note = f"{cpu_ms:.3f} ms of the server's processor each, {size / 1e3:.0f} kB"
        yield Figure(ROOM, what, rate, "1/s", f">= {aim:g}" if aim else "", None if aim is None else rate >= aim, note)
    client.close()
    assert head.startswith(b"HTTP/1.1 200")


def _cursors(client: LeanClient, running: Service) -> list[str]:
    """Return the cursors of 900 different parts."""
    found, path = [], f"{LISTS}&limit=1"
    for _ in range(SETS - 100):
        _, _, body = client.ask(request_of("GET", path, running.key))
        found.append(json.loads(body)["next"])
        path = f"{LISTS}&limit=1&cursor={found[-1]}"
    return found


def _rate(
    client: LeanClient, running: Service, request: Callable[[int], bytes], count: int, wanted: int
) -> tuple[float, float, int]:
    """Return answers a second, the server's processor time of each, ms, and the size of the last, bytes."""
    size = 0
    for turn in range(count // 10 + 1):
        client.ask(request(turn))
    cpu_s, begun = running.process.cpu_s(), time.perf_counter()
    for turn in range(count):
        status, _, body = client.ask(request(turn))
        size = len(body)
        if status != wanted:
            raise RuntimeError(f"{status}: {body[:300]!r}")
    elapsed_s = time.perf_counter() - begun
    return count / elapsed_s, 1e3 * (running.process.cpu_s() - cpu_s) / count, size


def _tag(head: bytes) -> str:
    return head.lower().partition(b"etag: ")[2].split(b"\r\n")[0].decode()
