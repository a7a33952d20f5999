"""Simulated sessions whose bias moves: steps, drift, waves and memory of known size beside white noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.dekart_mission import SESSIONS, tle_of
from magcal_core.simulation.telemetry import simulate

SENSOR = SensorModel(np.array([1200.0, -800.0, 500.0]), np.array([1.05, 0.97, 1.02]), np.array([0.8, -0.5, 0.4]))
STEP_S = 15.0


@cache
def clean(seed: int, hours: float) -> Samples:
    """Return readings without noise, with the true field beside them, of a body that tumbles as ``seed`` says."""
    made = simulate(
        Sgp4Orbit(tle_of(SESSIONS[0])), SENSOR, SESSIONS[0].start_utc, hours * 3600.0 - STEP_S, STEP_S, seed=seed
    )
    return made.samples_with_reference


def session(seed: int, moved_nt: np.ndarray | None = None, hours: float = 3.0, noise_nt: float = 100.0) -> Samples:
    """Return readings with noise and with ``moved_nt``, shape (n, 3), nT, added to the bias."""
    samples = clean(seed, hours)
    noise = noise_nt * np.random.default_rng(seed).normal(size=samples.h_nt.shape)
    return replace(samples, h_nt=samples.h_nt + noise + (0.0 if moved_nt is None else moved_nt))


def step_nt(samples: Samples, share: float, change_nt: tuple[float, float, float]) -> np.ndarray:
    """Return a step of the bias after a ``share`` of the samples, shape (n, 3), nT."""
    return np.outer(np.arange(len(samples)) >= round(share * len(samples)), change_nt)


def memory_nt(seed: int, samples: Samples, deviation_nt: float, memory_s: float) -> np.ndarray:
    """Return an Ornstein-Uhlenbeck process of each axis, shape (n, 3), nT."""
    rng = np.random.default_rng(10_000 + seed)
    kept = np.exp(-STEP_S / memory_s)
    state, found = rng.normal(size=3), np.empty((len(samples), 3))
    for i in range(len(samples)):
        found[i] = state
        state = kept * state + np.sqrt(1.0 - kept**2) * rng.normal(size=3)
    return deviation_nt * found


def time_of(samples: Samples, share: float) -> np.datetime64:
    """Return the time of the first sample after a step."""
    return samples.t_utc[round(share * len(samples))]
