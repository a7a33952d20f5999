"""A11: what one key at ten times its quota of uploads costs the uploads of another key.

The loud key has as many clients as it may have uploads in flight, then ten times as many; each of these comes back
after the second that its refusal names. The quiet key sends one upload after the other all the while. Turns of no, one
and ten times the quota follow each other, so that what else the machine does meets all of them.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final

import numpy as np

from benchmarks.clients import Bodies, Seen, p99_of, prepare_load, together
from benchmarks.measure import Figure
from benchmarks.service import LeanClient, Service, request_of, scratch, service

ROOM: Final = "tenants"
QUOTA: Final = 4
"""Uploads in flight of a key, set so low that the clients of ten times as many leave the server a processor."""
TIMES: Final = (0, 1, 10)
TURN_S: Final = float(os.environ.get("MAGCAL_BENCH_TURN_S", "4"))
ROUNDS: Final = int(os.environ.get("MAGCAL_BENCH_ROUNDS", "6"))
PAUSE_S: Final = 0.02
PATH: Final = "/satellites/quiet/sessions?magnetometer=mgm"


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with (
        scratch() as folder,
        service(folder, "--workers", "0", MIN_FREE_MB="0", MAX_UPLOADS_PER_KEY=str(QUOTA)) as running,
    ):
        loud, quiet = _two_keys(running)
        took_s: dict[int, list[float]] = {times: [] for times in TIMES}
        crowds = {times: Seen() for times in TIMES}
        for number in range(ROUNDS):
            for times in TIMES[:: 1 if number % 2 else -1]:
                seen, quiet_s = _turn(loud, quiet, times * QUOTA)
                took_s[times] += quiet_s
                crowds[times].statuses.update(seen.statuses)
        yield from _told(took_s, crowds)


def _two_keys(running: Service) -> tuple[Service, Service]:
    """Return the service as a loud and as a quiet key see it, each bound to a satellite of its own."""
    prepare_load(running)
    with running.client() as api:
        api.post("/satellites", json={"id": "quiet"}).raise_for_status()
        api.post("/satellites/quiet/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        keys = []
        for satellite in ("load", "quiet"):
            asked = api.post("/keys", json={"scopes": ["ingest"], "satellites": [satellite]})
            keys.append(replace(running, key=asked.raise_for_status().json()["key"]))
    return keys[0], keys[1]


def _turn(loud: Service, quiet: Service, clients: int) -> tuple[Seen, list[float]]:
    """Return what ``clients`` of the loud key saw, and what uploads of the quiet key took meanwhile, s."""
    with ThreadPoolExecutor(1) as pool:
        until = time.monotonic() + TURN_S
        sending = pool.submit(_quietly, quiet, until)
        seen = asyncio.run(together([loud], clients, Bodies(10_000), TURN_S))
        return seen, sending.result()


def _quietly(quiet: Service, until: float) -> list[float]:
    client, bodies, took_s = LeanClient(quiet.port), Bodies(10_000), list[float]()
    while time.monotonic() < until:
        request = request_of("POST", PATH, quiet.key, {"Content-Type": "text/csv"}, bodies.next())
        begun = time.perf_counter()
        status, _, body = client.ask(request)
        if status != 201:
            raise RuntimeError(f"an upload of the quiet key was answered {status}: {body[:200]!r}")
        took_s.append(time.perf_counter() - begun)
        time.sleep(PAUSE_S)
    client.close()
    return took_s


def _told(took_s: dict[int, list[float]], crowds: dict[int, Seen]) -> Iterator[Figure]:
    for times in TIMES:
        note = f"median {1e3 * float(np.median(took_s[times])):.1f} ms of {len(took_s[times])}; the other key: "
        note += str(dict(crowds[times].statuses)) if times else "silent"
        yield Figure(
            ROOM,
            f"upload of one key, another at {times} x its quota, p99",
            1e3 * p99_of(took_s[times]),
            "ms",
            note=note,
        )
    more = 100 * (p99_of(took_s[10]) / p99_of(took_s[1]) - 1)
    yield Figure(ROOM, "A11 ten times the quota against once, p99", more, "% more", "<= 20", more <= 20)
    more = 100 * (float(np.median(took_s[10])) / float(np.median(took_s[1])) - 1)
    yield Figure(ROOM, "A11 ten times the quota against once, median", more, "% more")
