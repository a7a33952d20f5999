"""The mission of the demonstration: two sessions of DEKART, simulated with the parameters that its paper prints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.orbit.messages.tle import Tle, parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.sensor.model import SensorModel

if TYPE_CHECKING:
    from magcal_core.simulation.telemetry import Simulation

STEP_S: Final = 10.0
NOISE_NT: Final = 100.0


@dataclass(frozen=True, slots=True)
class Pass:
    """One session: when it begins, how many samples it has, and the sensor's true parameters."""

    name: str
    start_utc: np.datetime64
    samples: int
    sensor: SensorModel
    seed: int


SESSIONS: Final = (
    Pass(
        "session 1",
        np.datetime64("2022-02-19T22:37:44.130", "ns"),
        700,
        SensorModel(
            np.array([2928.125, -1191.25, -1875.625]),
            np.array([1.032695, 1.006685, 1.032875]),
            np.array([-4.53, -1.067, 7.915]),
        ),
        1,
    ),
    Pass(
        "session 2",
        np.datetime64("2022-04-07T21:42:49.300", "ns"),
        1400,
        SensorModel(
            np.array([2807.5, -2056.25, -2070.625]),
            np.array([1.024175, 0.988788, 1.026907]),
            np.array([-4.22, -2.133, 8.504]),
        ),
        2,
    ),
)
"""Tables 1 and 2 of the DEKART paper (`docs/references.md`: DEKART)."""


@cache
def tle_text() -> str:
    """Return the two TLEs of DEKART, one near each session."""
    return resources.files("app.demo").joinpath("dekart.tle.txt").read_text(encoding="utf-8")


def tle_of(session: Pass) -> Tle:
    """Return the TLE whose epoch is nearest to the session."""
    return min(parse_tles(tle_text()), key=lambda tle: abs(tle.epoch_utc - session.start_utc))


def simulated(session: Pass, samples: int | None = None) -> Simulation:
    """Return the telemetry of a session, with its truth; ``samples`` cuts it short."""
    from magcal_core.simulation.telemetry import Disturbances, simulate

    count = session.samples if samples is None else samples
    return simulate(
        Sgp4Orbit(tle_of(session)),
        session.sensor,
        session.start_utc,
        duration_s=(count - 1) * STEP_S,
        step_s=STEP_S,
        disturbances=Disturbances(noise_nt=NOISE_NT),
        seed=session.seed,
    )
