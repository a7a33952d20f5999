"""When a simulated satellite samples its magnetometer: one function a plan, all in `SAMPLE_TIMES`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.simulation.flight import Flight
from magcal_core.simulation.missions import MOST_SAMPLES
from magcal_core.simulation.ranges import Draws

STEPS_S: Final = (1.0, 2.0, 5.0, 10.0, 30.0)
SHADOW_STEP_S: Final = 10.0
LEAST_SHADOW: Final = 0.2
"""Share of an orbit in shadow without which sparse samples in the sun are no plan."""

SampleTimes: TypeAlias = Callable[[Draws, Flight], Floats | None]
"""What is drawn and the flight to instants since its start, s, ascending; None where this orbit has none such."""


def steady(draws: Draws, _flight: Flight) -> Floats:
    """Return instants at a constant step."""
    return _steady(draws, 3600.0 * draws.of("duration_h"))


def transfer(draws: Draws, _flight: Flight) -> Floats:
    """Return instants at a constant step over most of a revolution and more."""
    return _steady(draws, 3600.0 * draws.of("transfer_h"))


def _steady(draws: Draws, duration_s: float) -> Floats:
    step_s = max(float(draws.random.choice(STEPS_S)), float(np.ceil(duration_s / MOST_SAMPLES)))
    return step_s * np.arange(int(duration_s / step_s), dtype=np.float64)


def passes(draws: Draws, _flight: Flight) -> Floats:
    """Return instants of passes over ground stations: minutes at a time, some times a day, over days."""
    days, minutes = draws.of("days"), draws.of("pass_min")
    count = int(np.ceil(days * draws.of("passes_per_day")))
    step_s = max(float(draws.random.choice(STEPS_S[:4])), float(np.ceil(60.0 * minutes * count / MOST_SAMPLES)))
    one_s = step_s * np.arange(int(60.0 * minutes / step_s) + 1)
    slot_s = 86400.0 * days / count
    starts_s = slot_s * (np.arange(count) + draws.random.uniform(0.0, 0.6, count))
    return np.asarray((starts_s[:, None] + one_s).ravel())


def sparse_in_the_sun(draws: Draws, flight: Flight) -> Floats | None:
    """Return instants every ten seconds in shadow and every few minutes in the sun."""
    every_s = np.arange(0.0, 3600.0 * draws.of("sparse_h"), SHADOW_STEP_S)
    is_shadow = flight.light(every_s) < 0.5
    if is_shadow.mean() < LEAST_SHADOW:
        return None
    apart = max(1, round(draws.of("sunlit_step_s") / SHADOW_STEP_S))
    return np.asarray(every_s[is_shadow | (np.arange(len(every_s)) % apart == 0)])


SAMPLE_TIMES: Final[Mapping[str, SampleTimes]] = {
    "steady": steady,
    "transfer": transfer,
    "passes": passes,
    "sparse in the sun": sparse_in_the_sun,
}
