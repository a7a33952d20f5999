"""The external field: do 95 % intervals of the scale factors hold with each field source; what does the field cost?

``MAGCAL_EXTERNAL`` sets the number of sessions at each inclination. The index is RC of 1997 to 2026 as chaosmagpy
brings it along.
"""

from __future__ import annotations

import importlib
import os
import time
import warnings
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.measure import Figure, interleaved_s
from magcal_core.field.index import Index
from magcal_core.field.index_files import read_index
from magcal_core.field.models import field_model
from magcal_core.simulation.external_missions import scale_held

IS_STUDY = True
SESSIONS: Final = 100
FIELDS: Final = ("igrf-14", "igrf-14+mean", "igrf-14+dst", "igrf-14+rc")
INCLINATIONS: Final = (10.0, 28.0, 52.0, 70.0, 98.0)
RATIOS: Final = {13: 1.8, 20: 2.6, 60: 25.0, 133: 110.0}
"""Degree of a file -> most processor time of its field against that of IGRF-14."""
_CHUNK: Final = 20_000


@cache
def rc_index() -> Index:
    """Return RC of 1997 to 2026."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says that Matplotlib is not installed
        folder = Path(str(importlib.import_module("chaosmagpy").__file__)).parent
    return read_index(folder / "lib" / "RC_index.h5")


def held(field: str, inclination_deg: float, seeds: range) -> float:
    """Return the share of scale factors whose 95 % interval holds the truth."""
    return float(np.mean([scale_held(field, rc_index(), inclination_deg, seed) for seed in seeds]))


def coverage() -> Iterator[Figure]:
    """Yield the coverage of the scale factors by field and inclination."""
    sessions = int(os.environ.get("MAGCAL_EXTERNAL", SESSIONS))
    for field in FIELDS:
        for inclination in INCLINATIONS:
            share = 100.0 * held(field, inclination, range(sessions))
            what = f"scale factors held, {field}, {inclination:g} deg"
            yield Figure("external", what, share, "%", "90 to 100", share >= 90.0, f"{sessions} sessions")


def speed() -> Iterator[Figure]:
    """Yield what the field costs, processor time of one core, against IGRF-14 alone."""
    random = np.random.default_rng(1)
    t_utc = np.datetime64("2024-05-08", "ns") + (np.arange(_CHUNK) * 10_000_000_000).astype("timedelta64[ns]")
    places = random.normal(size=(_CHUNK, 3))
    places *= (random.uniform(6671.0, 7171.0, _CHUNK) / np.linalg.norm(places, axis=1))[:, None]
    plain = field_model("igrf-14")
    models = {"+rc": field_model("igrf-14+rc", index=rc_index())}
    models |= {f"file of degree {n}": field_model("file", field_file=made_up_file(n)) for n in RATIOS}
    aims = {"+rc": 1.3} | {f"file of degree {n}": most for n, most in RATIOS.items()}
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        for name, model in models.items():
            candidates = {
                "plain": partial(plain.field_itrf_nt, t_utc, places),
                "other": partial(model.field_itrf_nt, t_utc, places),
            }
            spent = interleaved_s(candidates, rounds=15, clock=time.process_time)
            ratio, most = spent["other"] / spent["plain"], aims[name]
            yield Figure("external", f"time of {name} / igrf-14, one core", ratio, "x", f"<= {most:g}", ratio <= most)
    finally:
        os.sched_setaffinity(0, cores)


def made_up_file(degree: int) -> bytes:
    """Return coefficients from 2020 to 2030 up to ``degree``: the cost does not depend on their values."""
    rows = [
        f"{n} {m} {30000.0 / n**3:.3f} {30010.0 / n**3:.3f}" for n in range(1, degree + 1) for m in range(-n, n + 1)
    ]
    return "\n".join([f"1 {degree} 2 2 1", "2020.0 2030.0", *rows]).encode()


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    yield from speed()
    yield from coverage()
