"""Sessions with columns that say nothing of the sensor, and with one that does, beside a slow error of the bias."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, lfiltic

from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, simulate
from tests.magcal_core.fresh import Flown, fresh_orbit

Floats = NDArray[np.float64]

MINUTES: Final = 233.0
STEP_S: Final = 10.0
ERRORS: Final = ("none", "wave", "heat", "walk", "memory")
"""Slow errors of the bias that no column explains, 100 nT."""
FULL_TABLE: Final = 53
"""Columns of a full operations table."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session with its columns, of which ``true`` alone moves the bias; "" where none does."""

    flown: Flown
    columns: Mapping[str, Floats]
    true: str


def draw(seed: int, error: str, true: str, *, columns: int = 12) -> Session:
    """Return session number ``seed`` with a slow ``error`` of the bias, and a column that moves it, named ``true``."""
    random = np.random.default_rng([seed, ERRORS.index(error), 77])
    start = np.datetime64("2021-06-01", "ns") + np.timedelta64(int(random.uniform(0, 1e8)), "s")
    orbit = fresh_orbit(random, start)
    sensor = SensorModel(random.uniform(-20000, 20000, 3), random.uniform(0.9, 1.1, 3), random.uniform(-4, 4, 3))
    made = simulate(
        orbit,
        sensor,
        start,
        60.0 * MINUTES,
        STEP_S,
        rate_deg_s=float(np.exp(random.uniform(np.log(0.2), np.log(2.0)))),
        moments=(0.08, 0.1, 0.06),
        disturbances=Disturbances(noise_nt=60.0),
        seed=seed,
    )
    samples = made.samples_with_reference
    t_s = STEP_S * np.arange(len(samples))
    orbit_s = 86_400.0 / orbit.elements.mean_motion_rev_day
    decoys = dict(_decoys(random, t_s, columns, orbit_s))
    moved_nt = _slow_nt(error, t_s, random, orbit_s)
    if true:
        column = _true_column(true, t_s, random, orbit_s)
        decoys[true] = column
        direction = random.normal(size=3)
        direction /= np.linalg.norm(direction)
        size_nt = random.uniform(10.0, 25.0) if true == "temperature" else random.uniform(400.0, 900.0)
        effect = np.roll(column, 1) if true == "torquer" else column
        moved_nt = moved_nt + np.outer(effect - effect.mean(), size_nt * direction)
    spoiled = replace(samples, h_nt=samples.h_nt + moved_nt, housekeeping=decoys)
    return Session(Flown(spoiled, orbit, sensor, 60.0, random), decoys, true)


def _slow_nt(kind: str, t_s: Floats, random: np.random.Generator, orbit_s: float) -> Floats:
    direction, phase = random.normal(size=3), random.uniform(0, 2 * np.pi)
    direction /= np.linalg.norm(direction)
    if kind == "wave":
        period_s = 60.0 * float(np.exp(random.uniform(np.log(42.0), np.log(150.0))))
        return np.asarray(np.outer(np.sin(2 * np.pi * t_s / period_s + phase), 100.0 * direction))
    if kind == "heat":
        lit = np.clip(np.sin(2 * np.pi * t_s / orbit_s + phase) * 3.0 + 1.0, -1.0, 1.0)
        return np.asarray(np.outer(smoothed(lit, 600.0), 100.0 * direction))
    if kind == "walk":
        steps = random.normal(size=(len(t_s), 3)) * 100.0 / np.sqrt(len(t_s))
        return np.asarray(np.cumsum(steps, axis=0))
    if kind == "memory":
        share = np.exp(-STEP_S / 900.0)
        steps = 100.0 * np.sqrt(1 - share**2) * random.normal(size=(len(t_s), 3))
        return np.asarray(lfilter([1.0], [1.0, -share], steps, axis=0))
    return np.zeros((len(t_s), 3))


def smoothed(column: Floats, memory_s: float) -> Floats:
    """Return ``column`` through y' = (column - y) / memory, as what is heated follows the light."""
    share = np.exp(-STEP_S / memory_s)
    begin = lfiltic([1.0 - share], [1.0, -share], y=[column[0]])
    return np.asarray(lfilter([1.0 - share], [1.0, -share], column, zi=begin)[0])


def _orbital(t_s: Floats, random: np.random.Generator, orbit_s: float) -> Floats:
    """Return a column that follows the orbit: two harmonics, a slow drift, a little of its own, coarse steps."""
    phase = random.uniform(0, 2 * np.pi, 2)
    column = 10.0 * np.sin(2 * np.pi * t_s / orbit_s + phase[0])
    column += random.uniform(0, 4) * np.sin(4 * np.pi * t_s / orbit_s + phase[1])
    column += random.uniform(-3, 3) * t_s / t_s[-1] + 0.3 * random.normal(size=len(t_s))
    return np.asarray(np.round(20.0 + column, 1))


def _switching(t_s: Floats, random: np.random.Generator, _orbit_s: float) -> Floats:
    each = max(1, int(random.uniform(3, 60)))
    levels = random.normal(size=len(t_s) // each + 1)
    return np.repeat(levels, each)[: len(t_s)]


def _walk(t_s: Floats, random: np.random.Generator, _orbit_s: float) -> Floats:
    return np.asarray(np.cumsum(random.normal(size=len(t_s))))


def _true_column(name: str, t_s: Floats, random: np.random.Generator, orbit_s: float) -> Floats:
    if name == "temperature":
        return _orbital(t_s, random, orbit_s)
    each = 3
    return np.repeat(random.choice([-1.0, 0.0, 1.0], len(t_s) // each + 1), each)[: len(t_s)]


def _decoys(random: np.random.Generator, t_s: Floats, count: int, orbit_s: float) -> Iterator[tuple[str, Floats]]:
    makers = {"walk": _walk, "orbital": _orbital, "current": _switching}
    for number in range(count):
        name = list(makers)[number % 3]
        yield f"{name}_{chr(97 + number // 3)}", makers[name](t_s, random, orbit_s)
