"""What an answer's time tells of keys and bytes (A4, A7): interleaved requests over HTTP, medians and a rank test.

``MAGCAL_BENCH_PAIRS`` pairs (default 300; 10,000 for the long run). Both requests of a pair are of one length and go
over one connection, in turns the one and the other first.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from scipy.stats import mannwhitneyu

from benchmarks.measure import Figure
from benchmarks.service import LeanClient, Service, request_of, scratch, service

ROOM: Final = "access"
PAIRS: Final = int(os.environ.get("MAGCAL_BENCH_PAIRS", "300"))
KEY_AIM: Final = 1.0
BYTES_AIM: Final = 5.0
LEAST_P: Final = 0.01
CSV: Final = {"Content-Type": "text/csv"}


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    options = {"AUTH_FAILURES_PER_MINUTE": "1000000000", "MIN_FREE_MB": "0"}
    with scratch() as folder, service(folder, "--workers", "0", **options) as running:
        _prepare(running)
        client = LeanClient(running.port)
        yield from _keys(running, client)
        yield _bytes(running, client)
        client.close()


def _prepare(running: Service) -> None:
    with running.client() as api:
        for name in ("mine", "them"):
            api.post("/satellites", json={"id": name}).raise_for_status()
            api.post(f"/satellites/{name}/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()


def _key(running: Service, *scopes: str, satellite: str | None = None) -> str:
    satellites = None if satellite is None else [satellite]
    with running.client() as api:
        asked = api.post("/keys", json={"scopes": scopes, "satellites": satellites})
        return str(asked.raise_for_status().json()["key"])


def _keys(running: Service, client: LeanClient) -> Iterator[Figure]:
    """Yield A7: what the refusals of keys and of satellites take."""
    known, mine = _key(running, "ingest"), _key(running, "read", satellite="mine")
    wrong = known[:-2] + ("AA" if known[-2:] != "AA" else "BB")
    unknown = f"mgc_{'0' * 16}_{known[-43:]}"

    def ask(key: str, path: str, status: int) -> Callable[[int], None]:
        request = request_of("GET", path, key)

        def sent(_number: int) -> None:
            _expect(client.ask(request), status)

        return sent

    listing = "/satellites"
    cases = (
        ("A7 an unknown key against a wrong secret", ask(unknown, listing, 401), ask(wrong, listing, 401)),
        (
            "A7 the right secret without the scope against a wrong one",
            ask(known, listing, 403),
            ask(wrong, listing, 401),
        ),
        ("A7 another's satellite against none", ask(mine, "/satellites/them", 404), ask(mine, "/satellites/none", 404)),
    )
    for what, first, second in cases:
        yield _compared(what, KEY_AIM, first, second)


def _bytes(running: Service, client: LeanClient) -> Figure:
    """Return A4: what uploads of bytes take that another satellite has, and of bytes that none has."""
    mine = _key(running, "ingest", satellite="mine")

    def send(number: int, content: int, satellite: str = "mine", key: str = mine) -> None:
        path = f"/satellites/{satellite}/sessions?magnetometer=m"
        _expect(client.ask(request_of("POST", path, key, CSV, _csv(number, content))), 201)

    for number in range(PAIRS):
        send(number, 1, "them", running.key)
    return _compared(
        "A4 bytes that another satellite has against bytes that none has",
        BYTES_AIM,
        lambda number: send(number, 1),
        lambda number: send(number, 2),
    )


def _expect(answer: tuple[int, bytes, bytes], status: int) -> None:
    if answer[0] != status:
        raise RuntimeError(f"answered {answer[0]}, not {status}: {answer[2][:200]!r}")


def _compared(what: str, aim: float, first: Callable[[int], None], second: Callable[[int], None]) -> Figure:
    """Return by how much the medians of two requests differ, %, beside ``aim``, with the p-value of a rank test."""
    took_s = np.empty((PAIRS, 2))
    for number in range(PAIRS):
        for side in (0, 1) if number % 2 else (1, 0):
            begun = time.perf_counter()
            (first, second)[side](number)
            took_s[number, side] = time.perf_counter() - begun
    medians = np.median(took_s, axis=0)
    apart = 100.0 * abs(float(medians[0] / medians[1]) - 1.0)
    p_value = float(mannwhitneyu(took_s[:, 0], took_s[:, 1]).pvalue)
    note = f"medians {medians[0] * 1e3:.3f} and {medians[1] * 1e3:.3f} ms, p = {p_value:.3f}, {PAIRS} pairs"
    is_met = apart <= aim or (aim == KEY_AIM and p_value > LEAST_P)
    return Figure(ROOM, what, apart, "%", f"<= {aim:g}" + (" or p > 0.01" if aim == KEY_AIM else ""), is_met, note)


def _csv(number: int, content: int) -> bytes:
    rows = (f"2026-01-01T00:00:{i:02d}Z,{20_000 + number},{i},{content},36000" for i in range(40))
    return "\n".join(["time,bx,by,bz,ref_b", *rows, ""]).encode()
