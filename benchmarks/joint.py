"""What a joint fit of many sessions costs: twenty, and up to a thousand, where time is to grow with their number.

Sessions of 700 samples with their reference in the telemetry; ``MAGCAL_BENCH_JOINT=20,50`` for other numbers. Processor
time; the growth is the time of each session over that of each of twenty.
"""

from __future__ import annotations

import os
import time
import tracemalloc
from collections.abc import Iterator

import numpy as np

from benchmarks.measure import Figure, interleaved_s
from magcal_core.calibration.sessions.joint import joint_fit
from magcal_core.observations import Observations
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.missions import draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

ROOM = "joint"
FEW = 20
FEW_S = 0.15
GROWTH = 1.5
_START = np.datetime64("2022-01-01", "ns")
_SENSOR = SensorModel(np.array([2000.0, -1500.0, 800.0]), np.array([1.02, 0.97, 1.01]), np.array([1.0, -2.0, 1.5]))
_SIMULATED = 40


def sessions() -> list[Observations]:
    """Return sessions of 700 samples, six hours apart."""
    orbit, made = draw_orbit(np.random.default_rng(3), _START), []
    for i in range(_SIMULATED):
        at = _START + np.timedelta64(6 * i, "h")
        noise = Disturbances(30.0)
        found = simulate(orbit, _SENSOR, at, 7000.0, 10.0, rate_deg_s=0.5, disturbances=noise, seed=i)
        made.append(Observations.of(found.samples_with_reference, []))
    return made


def figures() -> Iterator[Figure]:
    """Yield the times of joint fits and how they grow."""
    made = sessions()
    few_s = interleaved_s({"few": lambda: joint_fit(made[:FEW])}, 5, time.process_time)["few"]
    yield Figure(ROOM, f"joint fit of {FEW} sessions of 700", few_s, "s", f"<= {FEW_S}", few_s <= FEW_S)
    for count in [int(number) for number in os.environ.get("MAGCAL_BENCH_JOINT", "100,300,1000").split(",")]:
        many = [made[i % len(made)] for i in range(count)]
        begin = time.process_time()
        joint_fit(many)
        took_s = time.process_time() - begin
        growth = took_s / count / (few_s / FEW)
        yield Figure(
            ROOM, f"joint fit of {count} sessions, time of each over that of each of {FEW}", growth, "times",
            f"<= {GROWTH}", growth <= GROWTH, f"{took_s:.3g} s, {_peak_mb(many):.0f} MB at most",
        )  # fmt: skip


def _peak_mb(many: list[Observations]) -> float:
    """Return the most memory that the joint fit holds beside the sessions, MB."""
    tracemalloc.start()
    try:
        joint_fit(many)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
