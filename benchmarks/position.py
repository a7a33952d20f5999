"""Positions from a TLE: ours against the bare `sgp4_array`, sparse and dense, and how far interpolation is off."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measure import Figure, interleaved_s
from magcal_core.orbit.earth.frames import teme_to_itrf
from magcal_core.orbit.earth.timescales import julian_utc
from magcal_core.orbit.messages.tle import checksum, parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

SAMPLES = 1_000_000
TLES = Path(__file__).resolve().parent.parent / "tests" / "data" / "dekart.tle.txt"


def _many_tles(n: int) -> str:
    """``n`` TLEs of one satellite over two years."""
    line1, line2 = TLES.read_text().splitlines()[1:3]
    texts = []
    for i in range(n):
        day = 1.0 + 730.0 * i / n
        epoch = f"{22 + int(day > 366):02d}{day - 365 * int(day > 366):012.8f}"
        body = f"{line1[:18]}{epoch}{line1[32:68]}"
        texts.append(f"{body}{checksum(body)}\n{line2}\n")
    return "".join(texts)


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    orbit = Sgp4Orbit(parse_tles(TLES.read_text())[0])
    satrec = orbit.elements.satrec()
    sparse = orbit.epoch_utc + np.arange(SAMPLES // 10) * np.timedelta64(60, "s")
    dense = orbit.epoch_utc + np.arange(SAMPLES) * np.timedelta64(1, "s")
    sparse_jd, dense_jd = julian_utc(sparse), julian_utc(dense)
    seconds = interleaved_s(
        {
            "bare, sparse": lambda: satrec.sgp4_array(*sparse_jd),
            "ours, sparse": lambda: orbit.position_itrf_km(sparse),
            "bare, dense": lambda: satrec.sgp4_array(*dense_jd),
            "ours, dense": lambda: orbit.position_itrf_km(dense),
        }
    )
    ratio = seconds["ours, sparse"] / seconds["bare, sparse"]
    note = f"{len(sparse) / seconds['ours, sparse'] / 1e6:.2f} M/s"
    yield Figure("position", "SGP4 to ITRF / bare sgp4_array, every 60 s", ratio, "x", "<= 1.3", ratio <= 1.3, note)
    ratio = seconds["bare, dense"] / seconds["ours, dense"]
    note = f"{len(dense) / seconds['ours, dense'] / 1e6:.1f} M/s"
    yield Figure("position", "bare sgp4_array / ours, every 1 s", ratio, "x", ">= 3", ratio >= 3.0, note)
    some = dense[:: SAMPLES // 20_000]
    away_km = orbit.position_itrf_km(dense)[:: SAMPLES // 20_000] - teme_to_itrf(some, orbit.state_teme(some)[0])
    away_m = 1e3 * float(np.abs(away_km).max())
    yield Figure("position", "interpolated from propagated position", away_m, "m", "<= 0.1", away_m <= 0.1)
    text = _many_tles(1500)
    start = time.perf_counter()
    orbits = [Sgp4Orbit(tle) for tle in parse_tles(text)]
    took_s = time.perf_counter() - start
    yield Figure("position", f"{len(orbits)} TLEs verified and initialised", took_s, "s", "<= 1", took_s <= 1.0)
