"""Monte Carlo of every estimator: bias against zero or its prediction, scatter against the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Figure
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.observations import Observations
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import simulate

Floats = NDArray[np.float64]

TABLE_1 = SensorModel(
    np.array([2928.125, -1191.25, -1875.625]),
    np.array([1.032695, 1.006685, 1.032875]),
    np.array([-4.53, -1.067, 7.915]),
)
TLES = Path(__file__).parent.parent / "tests" / "data" / "dekart.tle.txt"
FITS = {
    "scalar": ("scalar", FitSettings()),
    "scalar, white": ("scalar", FitSettings(noise_model="white")),
    "scalar, tukey": ("scalar", FitSettings("tukey")),
    "scalar-hooke-jeeves": ("scalar-hooke-jeeves", FitSettings()),
    "vector": ("vector", FitSettings()),
    "vector-closed-form": ("vector-closed-form", FitSettings()),
}
_SISTER = {"scalar-hooke-jeeves": "scalar"}
"""The search ends where Levenberg-Marquardt does; the latter is quicker on a million readings."""


@dataclass(frozen=True, slots=True)
class Scatter:
    """Bias in its own standard errors, before and after the predicted bias is taken off, and RMSE over the bound."""

    bias: Floats
    unpredicted: Floats
    over_bound: Floats


def mission(samples: int = 700) -> tuple[Observations, Floats]:
    """Return noise-free observations over the DEKART orbit, tumbling at 0.76 deg/s, and the planted parameters."""
    orbit = Sgp4Orbit(parse_tles(TLES.read_text())[0])
    flight = simulate(orbit, TABLE_1, orbit.epoch_utc, 10.0 * (samples - 1), 10.0, seed=7)
    truth = np.concatenate([TABLE_1.bias_nt, TABLE_1.scale, TABLE_1.nonorthogonality_deg])
    return Observations.of(flight.samples_with_reference), truth


def bound(clean: Observations, noise_nt: float, *, is_vector: bool) -> Floats:
    """Return the Cramer-Rao bound of each parameter: the formal error of a weighted fit at the planted noise."""
    noisy = replace(clean, h_nt=clean.h_nt + noise_nt * np.random.default_rng(0).normal(size=clean.h_nt.shape))
    settings = FitSettings() if is_vector else FitSettings(noise_model="white", noise_nt=noise_nt)
    fit = ESTIMATORS["vector" if is_vector else "scalar"].fit(noisy, settings)
    return np.asarray(fit.formal_standard_errors.vector * noise_nt / fit.sigma_nt)


def predicted_bias(name: str, clean: Observations, noise_nt: float) -> Floats:
    """Return the large-sample bias of a method: zero for the efficient ones, else that of a fit to a million readings.

    Plain |B| has a scale bias near 2 sigma^2 / <B^2>, the inverse regression an attenuation of its slopes.
    """
    method, settings = FITS[name]
    if method == "vector" or settings.noise_model == "white":
        return np.zeros(9)
    truth = np.concatenate([TABLE_1.bias_nt, TABLE_1.scale, TABLE_1.nonorthogonality_deg])
    random = np.random.default_rng(1)
    total = np.zeros(9)
    for _ in range(4):
        many = clean.take(np.tile(np.arange(len(clean)), 500))
        noise = noise_nt * random.normal(size=many.h_nt.shape)
        fit = ESTIMATORS[_SISTER.get(method, method)].fit(replace(many, h_nt=many.h_nt + noise), settings)
        total += fit.parameters.vector - truth
    return total / 4.0


def scatter_of(name: str, clean: Observations, truth: Floats, noise_nt: float, runs: int) -> Scatter:
    """Return bias and scatter of one estimator over ``runs`` noises."""
    method, settings = FITS[name]
    random = np.random.default_rng(2024)
    errors = np.empty((runs, 9))
    for i in range(runs):
        noisy = replace(clean, h_nt=clean.h_nt + noise_nt * random.normal(size=clean.h_nt.shape))
        errors[i] = ESTIMATORS[method].fit(noisy, settings).parameters.vector - truth
    spread = errors.std(axis=0, ddof=1) / np.sqrt(runs)
    predicted = predicted_bias(name, clean, noise_nt)
    unpredicted = errors.mean(axis=0) - predicted
    least = bound(clean, noise_nt, is_vector=ESTIMATORS[method].is_vector)
    rmse = np.sqrt(np.mean((errors - predicted) ** 2, axis=0))
    return Scatter(errors.mean(axis=0) / spread, unpredicted / spread, rmse / least)


def figures(runs: int = 200) -> Iterator[Figure]:
    """Yield bias and scatter of every estimator at 100 nT, and the scale bias at 1000 nT, where it shows."""
    clean, truth = mission()
    for name in FITS:
        found = scatter_of(name, clean, truth, 100.0, runs)
        worst = float(np.abs(found.unpredicted).max())
        ratio = float(found.over_bound.max())
        note = f"{runs} runs of 700 samples, 100 nT"
        yield Figure("montecarlo", f"{name}: worst bias", worst, "std errors", "<= 3", worst <= 3.0, note)
        yield Figure("montecarlo", f"{name}: worst RMSE / bound", ratio, "", "<= 1.15", ratio <= 1.15, note)
    for name in ("scalar", "scalar, white", "vector", "vector-closed-form"):
        found = scatter_of(name, clean, truth, 1000.0, runs)
        worst, raw = float(np.abs(found.unpredicted).max()), float(np.abs(found.bias).max())
        note = f"1000 nT; {raw:.1f} before the predicted bias is taken off"
        yield Figure("montecarlo", f"{name}: worst bias at 1000 nT", worst, "std errors", "<= 3", worst <= 3, note)
