"""How often the clock offset of a TLE is found, and how often one is found where there is none, over simulated passes.

Beside it what an ideal test of the same level would find: one that knows the noise and the wave's period beforehand and
reaches the Cramer-Rao bound. More than it no method can find.

``MAGCAL_CLOCK_PASSES`` sets the number of passes of each kind.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from benchmarks.measure import Figure
from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import rotate
from magcal_core.calibration.terms.clock import SIGNIFICANCE
from magcal_core.errors import EstimationError
from magcal_core.field.igrf import Igrf
from magcal_core.observations import Observations, residuals_nt
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.missions import draw_orbit
from magcal_core.simulation.telemetry import Disturbances, Simulation, simulate

IS_STUDY = True
PASSES = 200
OFFSETS_S = (0.0, 0.5, 1.0)
SMALLEST_S, LARGEST_S = 0.5, 30.0
"""Offsets that are drawn lie between these, either way."""
WAVE_PERIOD_S = 5640.0
_STEPS = np.array([1.0] * 3 + [1e-4] * 3 + [1e-3] * 3)
"""Steps of the derivatives by bias, nT, scale, and angle, deg."""


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
    """What was found in one pass: offset and its error, s, the offset that such a pass shows for certain, the test.

    ``least_error_s``: the smallest standard error that any estimate could have.
    """

    offset_s: float
    error_s: float
    detectable_s: float
    is_significant: bool
    least_error_s: float

    def ideal_power(self, offset_s: float) -> float:
        """Return the probability with which an ideal test of the same level finds ``offset_s``."""
        away, limit = offset_s / self.least_error_s, float(ndtri(SIGNIFICANCE / 2.0))
        return float(ndtr(limit + away) + ndtr(limit - away))


def evenly_s(seed: int) -> float:
    """Return the offset of pass number ``seed``, s: all from `SMALLEST_S` to `LARGEST_S` are equally likely."""
    random = np.random.default_rng([seed, 1])
    return float(random.choice([-1.0, 1.0]) * random.uniform(SMALLEST_S, LARGEST_S))


def by_logarithm_s(seed: int) -> float:
    """Return the offset of pass number ``seed``, s: every factor from `SMALLEST_S` to `LARGEST_S` equally likely."""
    random = np.random.default_rng([seed, 2])
    return float(random.choice([-1.0, 1.0]) * np.exp(random.uniform(np.log(SMALLEST_S), np.log(LARGEST_S))))


def find(kind: Kind, offset_s: float, seed: int) -> Found | None:
    """Return what is found of ``offset_s`` in pass number ``seed``; None where there is no calibration."""
    random = np.random.default_rng([seed, KINDS.index(kind) if kind in KINDS else 0])
    start = np.datetime64("2022-01-01", "ns") + np.timedelta64(int(random.uniform(0, 3e7)), "s")
    orbit = draw_orbit(random, start)
    sensor = SensorModel(random.uniform(-4000, 4000, 3), random.uniform(0.95, 1.05, 3), random.uniform(-5, 5, 3))
    wave = kind.wave_nt * random.normal(size=3) / np.sqrt(3.0)
    disturbed = Disturbances(
        kind.noise_nt, time_offset_s=offset_s, wave_nt=(wave[0], wave[1], wave[2]), wave_period_s=WAVE_PERIOD_S
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
    least_s = least_error_s(kind, made, orbit, sensor)
    return Found(clock["offset_s"], clock["standard_error_s"], clock["detectable_s"], clock["is_significant"], least_s)


def least_error_s(kind: Kind, made: Simulation, orbit: Orbit, sensor: SensorModel) -> float:
    """Return the Cramer-Rao bound of the offset, s: sensor and wave unknown, noise and the wave's period known.

    The scale factors' few percent in the noise of a corrected reading are left out.
    """
    is_vector = kind.method.startswith("vector")
    observations = Observations.of(made.samples_with_reference)
    at = Parameters(sensor.bias_nt, sensor.scale, sensor.nonorthogonality_deg)

    def residuals(values: Floats) -> Floats:
        return residuals_nt(observations, at.with_vector(values), is_vector)

    nudges = np.diag(_STEPS)
    columns = [(residuals(at.vector + by) - residuals(at.vector - by)) / (2 * by.max()) for by in nudges]
    if kind.wave_nt:
        phase = 2 * np.pi * observations.t_s / WAVE_PERIOD_S
        for shape in (np.sin(phase), np.cos(phase)):
            columns += [(shape * column.T).T for column in columns[:3]]
    columns.append(_rate_nt_s(made, orbit, is_vector=is_vector))
    jacobian = np.column_stack([column.ravel() for column in columns])
    size = np.linalg.norm(jacobian, axis=0)
    normal = (jacobian / size).T @ (jacobian / size)
    return float(kind.noise_nt * np.sqrt(np.linalg.inv(normal)[-1, -1]) / size[-1])


def _rate_nt_s(made: Simulation, orbit: Orbit, *, is_vector: bool) -> Floats:
    """Return the change of the reference with its time, nT/s: shape (n, 3) in the base frame, or (n,) of |B|."""
    half, sides = np.timedelta64(500, "ms"), []
    for t_utc in (made.t_true_utc + half, made.t_true_utc - half):
        b_nt = Igrf().field_itrf_nt(t_utc, orbit.position_itrf_km(t_utc))
        q = made.samples.q_base_gcrf
        turned = rotate(q, itrf_to_gcrf_fast(t_utc, b_nt)) if is_vector and q is not None else b_nt
        sides.append(turned if is_vector else np.linalg.norm(b_nt, axis=1))
    return np.asarray(sides[0] - sides[1])


def figures() -> Iterator[Figure]:
    """Yield the share of passes in which offsets are found: drawn ones, over all kinds and each, then given ones."""
    passes = int(os.environ.get("MAGCAL_CLOCK_PASSES", PASSES))
    for law, drawn_s in (("evenly", evenly_s), ("by their logarithm", by_logarithm_s)):
        yield from _drawn(f"offsets of {SMALLEST_S:g} to {LARGEST_S:g} s, drawn {law}", drawn_s, passes)
    for kind in KINDS:
        for offset_s in OFFSETS_S:
            found = [one for one in (find(kind, offset_s, seed) for seed in range(passes)) if one is not None]
            share = 100.0 * float(np.mean([one.is_significant for one in found]))
            ideal = 100.0 * float(np.mean([one.ideal_power(offset_s) for one in found]))
            able = [one for one in found if one.detectable_s <= max(offset_s, 0.5)]
            note = (
                f"an ideal test {ideal:.0f} %; {len(found)} passes; "
                f"{100 * len(able) / len(found):.0f} % say that they show {max(offset_s, 0.5)} s"
            )
            if not offset_s:
                yield Figure("clock", f"{kind.name}: none, found", share, "%", "<= 5", share <= 5.0, note)
                continue
            yield Figure("clock", f"{kind.name}: {offset_s} s, found", share, "%", ">= 95", share >= 95.0, note)
            if able:
                sure = 100.0 * float(np.mean([one.is_significant for one in able]))
                what = f"{kind.name}: {offset_s} s, found where the pass says that it shows"
                yield Figure("clock", what, sure, "%", ">= 95", sure >= 95.0, f"{len(able)} passes")


def _drawn(what: str, drawn_s: Callable[[int], float], passes: int) -> Iterator[Figure]:
    """Yield the share of passes in which the offset that ``drawn_s`` gives each is found: over all kinds, and each."""
    shares, ideals = [], []
    for kind in KINDS:
        pairs = [(drawn_s(seed), find(kind, drawn_s(seed), seed)) for seed in range(passes)]
        found = [(offset_s, one) for offset_s, one in pairs if one is not None]
        shares.append(100.0 * float(np.mean([one.is_significant for _, one in found])))
        ideals.append(100.0 * float(np.mean([one.ideal_power(offset_s) for offset_s, one in found])))
    every = float(np.mean(shares))
    note = f"an ideal test {np.mean(ideals):.1f} %; {passes} passes of each of {len(KINDS)} kinds"
    yield Figure("clock", f"all kinds: {what}, found", every, "%", ">= 95", every >= 95.0, note)
    for kind, share, ideal in zip(KINDS, shares, ideals, strict=True):
        note = f"an ideal test {ideal:.1f} %; {passes} passes"
        yield Figure("clock", f"{kind.name}: {what}, found", share, "%", ">= 95", share >= 95.0, note)
