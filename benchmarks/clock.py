"""How often the clock offset of a TLE is found, and how often one is found where there is none, over simulated passes.

``MAGCAL_CLOCK_PASSES`` sets the number of passes of each kind.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.measure import Figure
from magcal_core.errors import EstimationError
from magcal_core.missions import draw_orbit
from magcal_core.options import CalibrationOptions
from magcal_core.pipeline import calibrate
from magcal_core.sensor import SensorModel
from magcal_core.simulation import Disturbances, simulate

PASSES = 200
OFFSETS_S = (0.0, 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of pass: its length, h, step, s, noise, nT, and the wave in its bias, nT."""

    name: str
    hours: float
    step_s: float
    noise_nt: float
    wave_nt: float
    method: str
    robust: str = "none"


KINDS = (
    Kind("quiet sensor, 3.2 h, |B|", 3.2, 10.0, 50.0, 0.0, "scalar"),
    Kind("quiet sensor, 3.2 h, vector", 3.2, 10.0, 50.0, 0.0, "vector"),
    Kind("DEKART, 2 orbits, 100 nT, |B|", 3.2, 10.0, 100.0, 0.0, "scalar"),
    Kind("DEKART, 2 orbits, 100 nT, vector, Huber", 3.2, 10.0, 100.0, 0.0, "vector", "huber"),
    Kind("BRO-4, 17.6 h, 50 nT, wave of 150 nT, |B|", 17.6, 25.0, 50.0, 150.0, "scalar"),
    Kind("BRO-4, 17.6 h, 50 nT, wave of 150 nT, vector", 17.6, 25.0, 50.0, 150.0, "vector"),
)


@dataclass(frozen=True, slots=True)
class Found:
    """What was found in one pass: offset and its error, s, the offset that such a pass shows for certain, the test."""

    offset_s: float
    error_s: float
    detectable_s: float
    is_significant: bool


def find(kind: Kind, offset_s: float, seed: int) -> Found | None:
    """Return what is found of ``offset_s`` in pass number ``seed``; None where there is no calibration."""
    random = np.random.default_rng([seed, KINDS.index(kind) if kind in KINDS else 0])
    start = np.datetime64("2022-01-01", "ns") + np.timedelta64(int(random.uniform(0, 3e7)), "s")
    orbit = draw_orbit(random, start)
    sensor = SensorModel(random.uniform(-4000, 4000, 3), random.uniform(0.95, 1.05, 3), random.uniform(-5, 5, 3))
    wave = kind.wave_nt * random.normal(size=3) / np.sqrt(3.0)
    disturbed = Disturbances(
        kind.noise_nt, time_offset_s=offset_s, wave_nt=(wave[0], wave[1], wave[2]), wave_period_s=5640.0
    )
    made = simulate(
        orbit,
        sensor,
        start,
        kind.hours * 3600.0,
        kind.step_s,
        rate_deg_s=float(np.exp(random.uniform(np.log(0.1), np.log(1.5)))),
        disturbances=disturbed,
        seed=seed,
    )
    options = CalibrationOptions(method=kind.method, robust=kind.robust, time_offset="estimate")
    try:
        clock = calibrate(made.samples, [orbit], options).extras["time_offset"]
    except EstimationError:
        return None
    assert isinstance(clock, dict)
    return Found(clock["offset_s"], clock["standard_error_s"], clock["detectable_s"], clock["is_significant"])


def figures() -> Iterator[Figure]:
    """Yield the share of passes in which each offset is found."""
    passes = int(os.environ.get("MAGCAL_CLOCK_PASSES", PASSES))
    for kind in KINDS:
        for offset_s in OFFSETS_S:
            found = [one for one in (find(kind, offset_s, seed) for seed in range(passes)) if one is not None]
            share = 100.0 * float(np.mean([one.is_significant for one in found]))
            able = [one for one in found if one.detectable_s <= max(offset_s, 0.5)]
            note = (
                f"{len(found)} passes; {100 * len(able) / len(found):.0f} % say that they show {max(offset_s, 0.5)} s"
            )
            if not offset_s:
                yield Figure("clock", f"{kind.name}: none, found", share, "%", "<= 5", share <= 5.0, note)
                continue
            yield Figure("clock", f"{kind.name}: {offset_s} s, found", share, "%", ">= 95", share >= 95.0, note)
            if able:
                sure = 100.0 * float(np.mean([one.is_significant for one in able]))
                what = f"{kind.name}: {offset_s} s, found where the pass says that it shows"
                yield Figure("clock", what, sure, "%", ">= 95", sure >= 95.0, f"{len(able)} passes")
