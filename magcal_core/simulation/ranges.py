"""The named ranges that missions of the population are drawn from, and what a mission drew of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from magcal_core.arrays import Floats


@dataclass(frozen=True, slots=True)
class Range:
    """What a figure may be: from ``low`` to ``high``, evenly, or evenly in its logarithm."""

    low: float
    high: float
    is_logarithmic: bool = False


RANGES: Final[Mapping[str, Range]] = {
    # what every mission has
    "noise_nt": Range(20.0, 300.0, is_logarithmic=True),
    "duration_h": Range(0.5, 24.0, is_logarithmic=True),
    "spike_share": Range(0.0, 0.05),
    "spike_nt": Range(2000.0, 20000.0),
    "dropped_share": Range(0.0, 0.2),
    "wave_nt": Range(0.0, 100.0),
    "wave_period_s": Range(1200.0, 12000.0),
    "drift_nt_per_h": Range(0.0, 20.0),
    "attitude_noise_deg": Range(0.0, 1.0),
    "orbit_age_days": Range(0.0, 10.0),
    # attitude
    "wobble_deg": Range(0.1, 5.0, is_logarithmic=True),
    "roll_deg_s": Range(0.01, 0.5, is_logarithmic=True),
    "spin_deg_s": Range(0.3, 10.0, is_logarithmic=True),
    "nutation_deg": Range(2.0, 30.0),
    "tumble_deg_s": Range(0.05, 3.0, is_logarithmic=True),
    "fast_spin_deg_s": Range(200.0, 720.0),
    "left_deg_s": Range(0.02, 0.5, is_logarithmic=True),
    "damping_h": Range(0.2, 1.5),
    "moment_kg_m2": Range(0.02, 0.06),
    "magnet_a_m2": Range(0.2, 1.0),
    "rod_a_m2": Range(0.005, 0.05, is_logarithmic=True),
    "coercive_t": Range(0.5e-5, 2.0e-5),
    # errors of the bias
    "heat_nt": Range(50.0, 500.0, is_logarithmic=True),
    "heating_s": Range(120.0, 3000.0, is_logarithmic=True),
    "cooling_s": Range(120.0, 3000.0, is_logarithmic=True),
    "panel_nt": Range(50.0, 500.0, is_logarithmic=True),
    "panel_limit": Range(0.5, 1.0),
    "torquer_nt": Range(200.0, 2000.0, is_logarithmic=True),
    "torquer_period_s": Range(5.0, 60.0, is_logarithmic=True),
    "torquer_duty": Range(0.1, 0.7),
    "walk_nt": Range(50.0, 600.0, is_logarithmic=True),
    # the sensor's electronics
    "step_nt": Range(20.0, 2000.0, is_logarithmic=True),
    "clipped_share": Range(0.02, 0.3),
    "turn_deg": Range(1.0, 40.0, is_logarithmic=True),
    "stuck_share": Range(0.05, 0.4),
    "cubic_share": Range(0.001, 0.03, is_logarithmic=True),
    # when there are samples
    "days": Range(2.0, 4.0),
    "passes_per_day": Range(2.0, 6.0),
    "pass_min": Range(5.0, 12.0),
    "sunlit_step_s": Range(120.0, 400.0),
    "sparse_h": Range(4.0, 12.0),
    # geostationary transfer
    "transfer_h": Range(8.0, 24.0),
    "transfer_perigee_km": Range(200.0, 700.0),
    "transfer_apogee_km": Range(33000.0, 36000.0),
    "transfer_inclination_deg": Range(3.0, 28.5),
}


@dataclass(frozen=True, slots=True, eq=False)
class Draws:
    """A source of chance that keeps what it drew from the named ranges."""

    random: np.random.Generator
    drawn: dict[str, float] = field(default_factory=dict)

    def of(self, name: str) -> float:
        """Return a figure from the range ``name``; one figure a mission."""
        chosen = RANGES[name]
        if chosen.is_logarithmic:
            figure = float(np.exp(self.random.uniform(np.log(chosen.low), np.log(chosen.high))))
        else:
            figure = float(self.random.uniform(chosen.low, chosen.high))
        self.drawn[name] = figure
        return figure

    def vector(self, name: str) -> Floats:
        """Return a vector, shape (3,), in a random direction, its length from the range ``name``."""
        return self.of(name) * self.direction()

    def direction(self) -> Floats:
        """Return a random unit vector, shape (3,)."""
        direction = self.random.normal(size=3)
        return np.asarray(direction / np.linalg.norm(direction))

    def chance(self, probability: float) -> bool:
        """Return true as often as ``probability`` says."""
        return bool(self.random.random() < probability)
