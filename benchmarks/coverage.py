"""Do 95 % intervals hold the truth under coloured errors? Kinds of error x lengths of session x methods.

No mission has a perfect reference: the field has an external part and anomalies of the crust that the model lacks, and
the orbit is late along its track, by an error drawn as large as TLEs of its age have. The kinds of error come on top.

``MAGCAL_COVERAGE`` sets the number of missions of each.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Figure
from magcal_core.errors import EstimationError
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.pipeline import calibrate
from magcal_core.reference.error_budget import DRAG_KM_PER_DAY2, DRIFT_KM_PER_DAY, EPOCH_ERROR_KM
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.missions import DisplacedOrbit, DisturbedField, draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

Floats = NDArray[np.float64]

IS_STUDY = True
MISSIONS: Final = 40
ORBIT_S: Final = 5700.0
ORBITS: Final = (0.5, 1.0, 2.0, 4.0, 10.0)
METHODS: Final = ("scalar", "vector", "vector-closed-form", "scalar-hooke-jeeves")
KINDS: Final = {
    "none": "white",
    "bias remembers 5 min, 100 nT": "random 5",
    "bias remembers 15 min, 100 nT": "random 15",
    "bias remembers 30 min, 100 nT": "random 30",
    "bias remembers 90 min, 100 nT": "random 90",
    "wave of 40 min, 250 nT, one axis": "wave",
    "temperature, 150 nT, one orbit": "temperature",
    "orbit 2.5 days old": "old",
}
FRESH_DAYS: Final = 0.5
OLD_DAYS: Final = 2.5
FLIGHT_KM_S: Final = 7.6
_INDEPENDENT: Final = 3
"""Of a mission's nine parameters, as how many independent ones they count."""


@dataclass(frozen=True, slots=True, eq=False)
class Covered:
    """Whether nine 95 % intervals hold the truth, and whether those of the bias hold its mean over the session."""

    truth: NDArray[np.bool_]
    session: NDArray[np.bool_]
    width: Floats


def covered(kind: str, orbits: float, method: str, seed: int) -> Covered | None:
    """Return what the intervals of one simulated mission hold; None where there is no calibration."""
    random = np.random.default_rng([seed, int(2 * orbits), *kind.encode()])
    start = np.datetime64("2022-01-01", "ns") + np.timedelta64(int(random.uniform(0, 3e7)), "s")
    orbit: Orbit = draw_orbit(random, start)
    sensor = SensorModel(random.uniform(-5000, 5000, 3), random.uniform(0.9, 1.1, 3), random.uniform(-5.0, 5.0, 3))
    rate_deg_s = float(np.exp(random.uniform(np.log(0.1), np.log(2.0))))
    made = simulate(
        orbit,
        sensor,
        start,
        orbits * ORBIT_S,
        10.0 if orbits <= 4 else 20.0,
        field_model=DisturbedField.drawn(random),
        rate_deg_s=rate_deg_s,
        moments=(0.08, 0.1, 0.06),
        disturbances=Disturbances(60.0),
        seed=seed,
    )
    t_s = (made.samples.t_utc - start) / np.timedelta64(1, "s")
    moved_nt = _bias_nt(kind, t_s, random)
    samples = replace(made.samples, h_nt=made.samples.h_nt + moved_nt)
    age_days = OLD_DAYS if kind == "old" else FRESH_DAYS
    late_km = float(
        random.normal() * np.hypot(EPOCH_ERROR_KM, DRIFT_KM_PER_DAY * age_days + DRAG_KM_PER_DAY2 * age_days**2)
    )
    reference = DisplacedOrbit(orbit, start, age_days, late_km / FLIGHT_KM_S, 0.0)
    try:
        found = calibrate(samples, [reference], CalibrationOptions(method=method))
    except EstimationError:
        return None
    truth = np.concatenate([sensor.bias_nt, sensor.scale, sensor.nonorthogonality_deg])
    off, errors = found.parameters.vector[:9] - truth, found.standard_errors.vector[:9]
    from_mean = off[:3] - moved_nt.mean(axis=0)
    return Covered(np.abs(off) <= 1.96 * errors, np.abs(from_mean) <= 1.96 * errors[:3], errors)


def _bias_nt(kind: str, t_s: Floats, random: np.random.Generator) -> Floats:
    """Return by how much the bias differs from its truth at ``t_s``, shape (n, 3), nT."""
    phase = random.uniform(0.0, 2.0 * np.pi)
    if kind == "wave":
        return np.asarray(np.outer(np.sin(2 * np.pi * t_s / 2400.0 + phase), 250.0 * np.eye(3)[random.integers(3)]))
    if kind == "temperature":
        return np.asarray(np.outer(np.sin(2 * np.pi * t_s / 5640.0 + phase), 150.0 * random.normal(size=3)))
    if not kind.startswith("random"):
        return np.zeros((len(t_s), 3))
    memory_s = 60.0 * float(kind.split()[1])
    share = np.exp(-np.diff(t_s, prepend=t_s[0] - 1e9) / memory_s)
    steps = 100.0 * random.normal(size=(len(t_s), 3)) * np.sqrt(1.0 - share**2)[:, None]
    values = np.empty_like(steps)
    last = np.zeros(3)
    for i in range(len(t_s)):
        last = share[i] * last + steps[i]
        values[i] = last
    return values


def wilson(share: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability that was seen as ``share`` in ``count`` trials."""
    z2 = 1.96**2 / count
    middle, half = (share + z2 / 2) / (1 + z2), np.sqrt(z2 * (share * (1 - share) + z2 / 4)) / (1 + z2)
    return float(middle - half), float(middle + half)


def figures() -> Iterator[Figure]:
    """Yield the coverage of every kind, length and method, over all nine parameters."""
    missions = int(os.environ.get("MAGCAL_COVERAGE", MISSIONS))
    for method in METHODS:
        for name, kind in KINDS.items():
            for orbits in ORBITS:
                drawn = (covered(kind, orbits, method, seed) for seed in range(missions))
                found = [one for one in drawn if one is not None]
                if not found:
                    continue
                truth = np.array([one.truth for one in found])
                share = 100.0 * float(truth.mean())
                groups = (100.0 * truth.mean(axis=0)).reshape(3, 3).mean(axis=1)
                session = 100.0 * float(np.mean([one.session for one in found]))
                low, high = wilson(share / 100.0, _INDEPENDENT * len(found))
                note = (
                    f"bias {groups[0]:.0f} (the session's {session:.0f}), scale {groups[1]:.0f}, "
                    f"angles {groups[2]:.0f}; by chance {100 * low:.0f} to {100 * high:.0f}"
                )
                what = f"{method}, {name}, {orbits:g} orbits"
                is_met = low <= 0.98 and high >= 0.90
                yield Figure("coverage", what, share, "%", "90 to 98", is_met, f"{note}; {len(found)} missions")
