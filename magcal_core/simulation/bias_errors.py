"""What moves the bias of a simulated magnetometer: one function an error, all in `BIAS_ERRORS`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import rotate
from magcal_core.simulation.attitude_modes import Motion
from magcal_core.simulation.flight import Flight
from magcal_core.simulation.ranges import Draws

_LIGHT_STEP_S: Final = 20.0
_REMEMBERED: Final = 6.0
"""Time constants before the start over which light is followed: 0.2 % is left."""


@dataclass(frozen=True, slots=True, eq=False)
class BiasError:
    """By how much the bias is off, shape (n, 3), nT, and the columns of telemetry that tell why.

    ``told_nt_per_unit``: columns of the telemetry that the calibration is given as regressors -> nT per unit, (3,);
    what they explain is in ``moved_nt`` as well.
    """

    moved_nt: Floats
    columns: Mapping[str, Floats] = field(default_factory=dict)
    told_nt_per_unit: Mapping[str, Floats] = field(default_factory=dict)


Error: TypeAlias = Callable[[Draws, Flight, Motion, Floats], BiasError]
"""What is drawn, flight, motion and instants, s, shape (n,), to the error of the bias at these."""


def everyday(draws: Draws, _flight: Flight, _motion: Motion, t_s: Floats) -> BiasError:
    """Return a wave and a drift: what every mission has."""
    wave = np.sin(2.0 * np.pi * t_s / draws.of("wave_period_s") + draws.random.uniform(0.0, 2.0 * np.pi))
    return BiasError(np.outer(wave, draws.vector("wave_nt")) + np.outer(t_s / 3600.0, draws.vector("drift_nt_per_h")))


def heat(draws: Draws, flight: Flight, _motion: Motion, t_s: Floats) -> BiasError:
    """Return an error that follows the satellite's temperature: it warms in the sun and cools in the Earth's shadow.

    Notes
    -----
    y' = (light - y) / tau, with one time constant for warming and another one for cooling.
    """
    warming_s, cooling_s = draws.of("heating_s"), draws.of("cooling_s")
    first_s = -_REMEMBERED * max(warming_s, cooling_s)
    grid_s = np.arange(first_s, t_s.max() + 2.0 * _LIGHT_STEP_S, _LIGHT_STEP_S)
    warmth = followed(flight.light(grid_s), _LIGHT_STEP_S, warming_s, cooling_s)
    return BiasError(np.outer(np.interp(t_s, grid_s, warmth), draws.vector("heat_nt")))


def followed(light: Floats, step_s: float, warming_s: float, cooling_s: float) -> Floats:
    """Return y of y' = (light - y) / tau, shape (n,), from the mean of ``light`` on, exact for constant steps."""
    y = np.empty_like(light)
    y[0] = light.mean()
    for i in range(1, len(light)):
        towards = light[i]
        tau_s = warming_s if towards > y[i - 1] else cooling_s
        y[i] = towards + (y[i - 1] - towards) * np.exp(-step_s / tau_s)
    return y


def panels(draws: Draws, flight: Flight, motion: Motion, t_s: Floats) -> BiasError:
    """Return the field of six panels' currents: of each as much as it faces the Sun, up to the charger's limit."""
    light, to_sun = flight.light(t_s), flight.sun_gcrf_km(t_s)
    sun_body = rotate(motion(t_s), to_sun / np.linalg.norm(to_sun, axis=1, keepdims=True))
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    loops_nt = draws.of("panel_nt") * np.array([draws.direction() for _ in normals])
    return BiasError(panel_currents(light, sun_body, normals, draws.of("panel_limit")) @ loops_nt)


def panel_currents(light: Floats, sun_body: Floats, normals: Floats, limit: float) -> Floats:
    """Return the currents, shape (n, m), of panels with ``normals``, shape (m, 3), as a share of the full one."""
    return np.asarray(light[:, None] * np.minimum(np.maximum(sun_body @ normals.T, 0.0), limit))


def torquers(draws: Draws, flight: Flight, motion: Motion, t_s: Floats) -> BiasError:
    """Return what coils add that are on for a part of each period: against the field's rate, or at random."""
    columns = torquer_columns(draws, flight, motion, t_s)
    return BiasError(columns @ _offsets_nt(draws).T)


def told_torquers(draws: Draws, flight: Flight, motion: Motion, t_s: Floats) -> BiasError:
    """Return the same, with the coils' states in the telemetry and given as regressors."""
    columns, offsets_nt = torquer_columns(draws, flight, motion, t_s), _offsets_nt(draws)
    named = {f"torquer_{i}": columns[:, i] for i in range(3)}
    told = {name: offsets_nt[:, i] for i, name in enumerate(named)}
    return BiasError(columns @ offsets_nt.T, named, told)


def torquer_columns(draws: Draws, flight: Flight, motion: Motion, t_s: Floats) -> Floats:
    """Return -1, 0 or 1 of each coil, shape (n, 3): on for the first part of each period, and off for the rest."""
    period_s, duty = draws.of("torquer_period_s"), draws.of("torquer_duty")
    cycle = np.floor(t_s / period_s)
    is_on = t_s / period_s - cycle < duty
    if draws.chance(0.5):
        # As B-dot commands: measured over the second before the coils are switched on.
        then_s = np.maximum(cycle * period_s - 1.0, 0.0)
        before, after = (rotate(motion(at_s), flight.field_gcrf_nt(at_s)) for at_s in (then_s, then_s + 1.0))
        state = -np.sign(after - before)
    else:
        numbers = cycle.astype(np.intp)
        state = draws.random.integers(-1, 2, (int(numbers.max()) + 1, 3))[numbers].astype(np.float64)
    return np.asarray(is_on[:, None] * state)


def _offsets_nt(draws: Draws) -> Floats:
    """Return what each coil adds at full current: a column each, shape (3, 3), nT."""
    return np.column_stack([draws.vector("torquer_nt") for _ in range(3)])


def random_walk(draws: Draws, _flight: Flight, _motion: Motion, t_s: Floats) -> BiasError:
    """Return a walk of each axis whose standard deviation has the size that is drawn at the end of the session."""
    steps_s = np.diff(t_s, prepend=t_s[:1])
    steps = draws.random.normal(size=(len(t_s), 3)) * np.sqrt(steps_s / max(float(t_s[-1] - t_s[0]), 1e-9))[:, None]
    return BiasError(draws.of("walk_nt") * np.cumsum(steps, axis=0))


BIAS_ERRORS: Final[Mapping[str, Error]] = {
    "heat": heat,
    "panels": panels,
    "torquers": torquers,
    "told torquers": told_torquers,
    "random walk": random_walk,
}
