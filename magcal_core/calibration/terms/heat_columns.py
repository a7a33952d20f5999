"""Light, and heat that follows it with a delay: known along an orbit whether or not there are samples.

Notes
-----
What the sun did while no sample was taken is still in the satellite's heat: sampled in shadow alone, its bias decays
from what the light before has left of it. So where an orbit is known, light is followed through gaps of the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.errors import OrbitMissingError, PropagationError
from magcal_core.numerics.kernel import kernel
from magcal_core.orbit import Orbit
from magcal_core.orbit.choose import choose_orbits
from magcal_core.orbit.earth.bodies import default_ephemeris, sun_moon_gcrf
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast

UMBRA_KM: Final = 6378.0
TIME_CONSTANTS_S: Final = (600.0, 2400.0)
_GAP_STEPS: Final = 10.0
_GAP_S: Final = 600.0
"""A step longer than ten usual ones and than this is a gap: what the light did in it no sample shows."""
_FOLLOWED_S: Final = 5.0 * TIME_CONSTANTS_S[-1]
"""How long before a sample light still counts, s: of what is older less than 1 % is left."""
LIGHT_AGE_DAYS: Final = 60.0
"""Age of an orbit up to which it tells light, days: a TLE is then minutes late, and so is its shadow."""
STATE_AGE_DAYS: Final = 3.0
"""The same of a state that is integrated, which takes its time."""
_FOLLOW_STEP: Final = np.timedelta64(20, "s")
_LONG_STEPS: Final = 2.0
_LONG_S: Final = 60.0
"""A step longer than two usual ones and than this is followed along the orbit."""
_SUN_NODE: Final = np.timedelta64(6, "h")


def sun_gcrf(t_utc: Times) -> Floats:
    """Return the direction of the sun, shape (n, 3), GCRF: of nodes 6 h apart, 2e-6 rad between them."""
    first, last = t_utc.min(), t_utc.max()
    nodes = np.append(np.arange(first, last, _SUN_NODE), [last, last + _SUN_NODE])
    s = sun_moon_gcrf(nodes, default_ephemeris())[0][:, 0]
    s = s / np.linalg.norm(s, axis=1)[:, None]
    at = (t_utc - first) / np.timedelta64(1, "s")
    knots = (nodes - first) / np.timedelta64(1, "s")
    return np.column_stack([np.interp(at, knots, s[:, i]) for i in range(3)])


def light_of(r_km: Floats, sun: Floats) -> Floats:
    """Return 1 in the sun and 0 in the umbra, shape (n,): a cylinder of `UMBRA_KM` behind the Earth."""
    along = np.einsum("ni,ni->n", r_km, sun)
    across = np.einsum("ni,ni->n", r_km, r_km) - along**2
    return np.where((along < 0.0) & (across < UMBRA_KM**2), 0.0, 1.0)


def heat_columns(t_utc: Times, light: Floats, orbits: Sequence[Orbit]) -> Floats:
    """Return light through y' = (light - y) / tau for both time constants, shape (n, 2), from the mean of light on.

    Parameters
    ----------
    t_utc : datetime64, shape (n,)
        Times of the samples, ascending.
    light : shape (n,)
        1 in the sun, 0 in the umbra.
    orbits : sequence of Orbit
        They tell the light in gaps between samples. In a gap that none covers y goes towards the mean of light.
    """
    steps = np.diff(t_utc, prepend=t_utc[:1]) / np.timedelta64(1, "s")
    gap_s = max(_GAP_STEPS * float(np.median(steps[1:])), _GAP_S) if len(steps) > 1 else _GAP_S
    long_s = max(_LONG_STEPS * float(np.median(steps[1:])), _LONG_S) if len(steps) > 1 else _LONG_S
    between, lit = _followed(t_utc, np.flatnonzero(steps > long_s), orbits)
    if not len(between):
        return _delayed(light, steps, gap_s, float(light.mean()))
    every = np.concatenate([t_utc, between])
    order = np.argsort(every, kind="stable")
    light_then = np.concatenate([light, lit])[order]
    steps = np.diff(every[order], prepend=every[order[:1]]) / np.timedelta64(1, "s")
    passed = np.where(steps > gap_s, 0.0, steps)
    mean = float(passed @ light_then / max(float(passed.sum()), 1e-9))
    rows = np.empty(len(order), np.intp)
    rows[order] = np.arange(len(order))
    return np.ascontiguousarray(_delayed(light_then, steps, gap_s, mean)[rows[: len(t_utc)]])


def places_itrf_km(t_utc: Times, orbits: Sequence[Orbit]) -> Floats | None:
    """Return the position at ``t_utc``, shape (n, 3), ITRF, km, NaN where no orbit is near; None where none is at all.

    For light alone: a time may be `LIGHT_AGE_DAYS` from the epoch of elements, `STATE_AGE_DAYS` from that of a state.
    """
    if not orbits or not len(t_utc):
        return None
    r_km = np.full((len(t_utc), 3), np.nan)
    with suppress(OrbitMissingError, PropagationError):
        choice = choose_orbits(orbits, t_utc)
        for i, rows in choice.by_orbit():
            limit = LIGHT_AGE_DAYS if orbits[i].model == "sgp4" else STATE_AGE_DAYS
            near = rows[choice.age_days[rows] <= limit]
            if len(near):
                r_km[near] = orbits[i].position_itrf_km(t_utc[near])
    return r_km


def light_along(t_utc: Times, orbits: Sequence[Orbit]) -> Floats | None:
    """Return 1 in the sun and 0 in the umbra at ``t_utc``, shape (n,); None where no orbit tells all places."""
    r_km = places_itrf_km(t_utc, orbits)
    if r_km is None or not np.isfinite(r_km).all():
        return None
    return light_of(itrf_to_gcrf_fast(t_utc, r_km), sun_gcrf(t_utc))


def _followed(t_utc: Times, ends: NDArray[np.intp], orbits: Sequence[Orbit]) -> tuple[Times, Floats]:
    """Return times in the gaps before the samples ``ends``, and the light then; none where no orbit tells it."""
    steps = int(_FOLLOWED_S * np.timedelta64(1, "s") / _FOLLOW_STEP)
    times = (t_utc[ends][:, None] - np.arange(steps, 0, -1) * _FOLLOW_STEP).astype(t_utc.dtype)
    times = times[times > t_utc[ends - 1][:, None]]
    r_km = places_itrf_km(times, orbits)
    known = np.zeros(len(times), dtype=bool) if r_km is None else np.isfinite(r_km).all(axis=1)
    if r_km is None or not known.any():
        return times[:0], np.zeros(0)
    times = times[known]
    return times, light_of(itrf_to_gcrf_fast(times, r_km[known]), sun_gcrf(times))


def _delayed(light: Floats, steps: Floats, gap_s: float, mean: float) -> Floats:
    return np.column_stack([_filtered(light, steps, gap_s, tau, mean) for tau in TIME_CONSTANTS_S])


@kernel()
def _filtered(
    light: Floats, steps: Floats, gap_s: float, tau_s: float, mean: float
) -> Floats:  # pragma: no cover - compiled
    """Return y of y' = (light - y) / tau from ``mean`` on; in a gap it goes towards ``mean``."""
    y = np.empty(light.size)
    here = mean
    for i in range(light.size):
        if i:
            towards = mean if steps[i] > gap_s else light[i]
            here = towards + (here - towards) * np.exp(-steps[i] / tau_s)
        y[i] = here
    return y
