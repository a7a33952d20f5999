"""Missions drawn anew: orbits of 400 to 800 km, 30 to 98 deg, noise of 20 to 300 nT, 200 to 3000 samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.missions import draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

STEPS_S: Final = (2.0, 5.0, 10.0, 15.0)
SHORTEST_S: Final = 2400.0
"""Two fifths of an orbit: what is shorter is a matter of motion, not of garbage."""
LONGEST_S: Final = 4.0 * 3600.0
_EARTH_RADIUS_KM: Final = 6378.137
_GM_KM3_S2: Final = 398600.4418


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """One session: what was sent with the true field beside it, the orbit, the sensor, and its noise, nT."""

    samples: Samples
    orbit: Sgp4Orbit
    sensor: SensorModel
    noise_nt: float
    random: np.random.Generator

    def sent(self, samples: Samples | None = None, *, is_vector: bool = False) -> Samples:
        """Return ``samples`` as a station has them: no reference beside them, attitude for vector methods alone."""
        one = self.samples if samples is None else samples
        bare = replace(one, b_ref_base_nt=None, b_ref_magnitude_nt=None)
        return bare if is_vector else replace(bare, q_base_gcrf=None)


def fresh_orbit(random: np.random.Generator, start: np.datetime64) -> Sgp4Orbit:
    """Return an orbit of 400 to 800 km and 30 to 98 deg with its epoch at ``start``."""
    while True:
        orbit = draw_orbit(random, start)
        mean_motion = 2.0 * np.pi * orbit.elements.mean_motion_rev_day / 86400.0
        height_km = float((_GM_KM3_S2 / mean_motion**2) ** (1.0 / 3.0)) - _EARTH_RADIUS_KM
        if 400.0 <= height_km <= 800.0 and 30.0 <= orbit.elements.inclination_deg <= 98.0:
            return orbit


def fresh(seed: int, *, noise_nt: float | None = None) -> Flown:
    """Return mission number ``seed``: bias to 20 uT, scale 10 %, angles 4 deg, tumbling at 0.2 to 2 deg/s."""
    random = np.random.default_rng([seed, 20261130])
    start = np.datetime64("2021-01-01", "ns") + np.timedelta64(int(random.uniform(0, 1.2e8)), "s")
    orbit = fresh_orbit(random, start)
    sensor = SensorModel(random.uniform(-20000, 20000, 3), random.uniform(0.9, 1.1, 3), random.uniform(-4, 4, 3))
    step_s = float(random.choice(STEPS_S))
    count = float(np.exp(random.uniform(np.log(200), np.log(3000))))
    duration_s = float(np.clip(count * step_s, max(SHORTEST_S, 200 * step_s), min(LONGEST_S, 3000 * step_s)))
    drawn_nt = float(np.exp(random.uniform(np.log(20.0), np.log(300.0)))) if noise_nt is None else noise_nt
    made = simulate(
        orbit,
        sensor,
        start,
        duration_s,
        step_s,
        rate_deg_s=float(np.exp(random.uniform(np.log(0.2), np.log(2.0)))),
        moments=(0.08, 0.1, 0.06),
        disturbances=Disturbances(noise_nt=drawn_nt),
        seed=seed,
    )
    return Flown(made.samples_with_reference, orbit, sensor, drawn_nt, random)
