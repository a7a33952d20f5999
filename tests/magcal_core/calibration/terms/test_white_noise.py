"""White noise in the reading beside a clock that is taken: each has its place among the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.dekart_mission import SESSIONS, tle_of
from magcal_core.simulation.telemetry import Disturbances, simulate

CLOCK_S = 20.0
NOISE_NT = 1000.0


def test_noise_that_moves_the_scale_is_fitted_beside_a_clock_that_was_taken() -> None:
    """The scale factors are 2 sigma^2 / B^2 = 0.15 % too large without the noise model, some of their errors."""
    orbit = Sgp4Orbit(tle_of(SESSIONS[0]))
    sensor = SensorModel(np.array([3000.0, -1000.0, 2000.0]), np.array([1.02, 0.98, 1.01]), np.array([1.0, -1.0, 2.0]))
    noisy = Disturbances(noise_nt=NOISE_NT, time_offset_s=CLOCK_S)
    start = np.datetime64("2022-02-19T22:37:44")
    made = simulate(orbit, sensor, start, 14000.0, 5.0, disturbances=noisy, seed=3)
    found = calibrate(replace(made.samples, q_base_gcrf=None), [orbit])
    assert found.extras["noise_model_used"] == "white"
    assert found.parameters.time_offset_s is not None
    assert abs(found.parameters.time_offset_s - CLOCK_S) < 3.0
    assert np.all(np.abs(found.parameters.scale - sensor.scale) < 4.0 * found.standard_errors.scale)
