"""Numerical orbits laid through SGP4: what its states leave out is averaged over a stretch of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.errors import OptionError, PropagationError
from magcal_core.orbit import Orbit
from magcal_core.orbit.choose import NO_ORBIT, BoundedOrbit, choose_orbits
from magcal_core.orbit.propagators.numerical import NumericalOrbit

FIT_DAYS: Final = 1.0
"""Length of the stretch of another orbit through which `numerical_from` lays a numerical one."""


def numerical_from(
    orbit: Orbit,
    method: Literal["fit", "epoch"] = "fit",
    *,
    degree: int = 12,
    third_bodies: bool = True,
    fit_days: float = FIT_DAYS,
    around_utc: np.datetime64 | None = None,
) -> Orbit:
    """Return a numerical orbit in place of ``orbit``, such as SGP4; a numerical orbit or an ephemeris stays as it is.

    Parameters
    ----------
    method : str
        ``fit``, the default: by least squares through a stretch of ``fit_days``. SGP4 leaves out short-periodic terms,
        so that its states are hundreds of metres off, and the period with them; the fit averages that out.
        ``epoch``: from the one state at the epoch, as the DEKART paper does (docs/numerical-orbit.md has figures).
    around_utc : datetime64, optional
        Middle of the stretch, such as the middle of the telemetry; by default the orbit's epoch. The numerical orbit
        keeps the epoch of ``orbit`` either way, and with it the age of what it was made from.

    Raises
    ------
    OptionError
        The method is neither.
    PropagationError
        The orbit cannot be propagated, or the fit does not converge.
    """
    if isinstance(orbit, NumericalOrbit | BoundedOrbit):
        return orbit
    if method == "epoch":
        r_km, v_km_s = orbit.state_gcrf(np.array([orbit.epoch_utc], "datetime64[ns]"))
        return NumericalOrbit(orbit.epoch_utc, r_km[0], v_km_s[0], degree, third_bodies)
    if method != "fit":
        raise OptionError(f"unknown way to a numerical orbit {method!r}; known are fit, epoch")
    middle_s = 0.0 if around_utc is None else float((around_utc - orbit.epoch_utc) / np.timedelta64(1, "ns")) / 1e9
    half_s = fit_days * 43200.0
    return fitted_to(orbit, middle_s - half_s, middle_s + half_s, degree=degree, third_bodies=third_bodies)


def numerical_orbits(orbits: Sequence[Orbit], t_utc: Times) -> list[Orbit]:
    """Return ``orbits`` with a numerical one in place of each that gives a position at some of ``t_utc``, shape (n,).

    Each is fitted about the times that it serves, over a day or as long as they last; the others stay as they are,
    since no sample asks them.

    Raises
    ------
    OrbitMissingError
        There is no orbit at all.
    PropagationError
        An orbit cannot be propagated, or a fit does not converge.
    """
    choice = choose_orbits(orbits, t_utc)
    replaced = list(orbits)
    for i in np.unique(choice.index[choice.index != NO_ORBIT]):
        served = t_utc[choice.rows(int(i))]
        span = served.max() - served.min()
        days = max(FIT_DAYS, float(span / np.timedelta64(1, "D")))
        replaced[i] = numerical_from(orbits[i], fit_days=days, around_utc=served.min() + span // 2)
    return replaced


def fitted_to(
    orbit: Orbit, from_s: float, until_s: float, *, degree: int = 12, third_bodies: bool = True
) -> NumericalOrbit:
    """Return the numerical orbit nearest to the positions of ``orbit`` from ``from_s`` to ``until_s`` since its epoch.

    Raises
    ------
    PropagationError
        The fit does not converge within 20 iterations.

    Notes
    -----
    Gauss-Newton for the state in the middle of the stretch, positions once a minute with equal weight; the partial
    derivatives are differences of orbits in the field of degree 2, which is near enough for a step. The state is then
    carried to the epoch.
    """
    if not until_s > from_s:
        raise OptionError(f"the stretch to fit ends at {until_s} s, before it begins at {from_s} s")
    offsets_s = np.linspace(from_s, until_s, 2 * max(int((until_s - from_s) / 120.0), 10) + 1)
    t_utc = orbit.epoch_utc + np.round(offsets_s * 1e9).astype("timedelta64[ns]")
    middle = t_utc[len(t_utc) // 2]
    wanted_km, wanted_km_s = orbit.state_gcrf(t_utc)
    state = np.concatenate([wanted_km[len(t_utc) // 2], wanted_km_s[len(t_utc) // 2]])
    partials = _position_partials(middle, state, t_utc)
    for _ in range(20):
        fitted = NumericalOrbit(middle, state[:3], state[3:], degree, third_bodies)
        step = np.linalg.lstsq(partials, (wanted_km - fitted.state_gcrf(t_utc)[0]).ravel(), rcond=None)[0]
        state = state + step
        if np.abs(step[:3]).max() < 1e-6 and np.abs(step[3:]).max() < 1e-9:
            best = NumericalOrbit(middle, state[:3], state[3:], degree, third_bodies)
            r_km, v_km_s = best.state_gcrf(np.array([orbit.epoch_utc]))
            return NumericalOrbit(orbit.epoch_utc, r_km[0], v_km_s[0], degree, third_bodies)
    why = f"no convergence to the {orbit.model} orbit in 20 iterations"
    raise PropagationError(f"numerical orbit of {orbit.epoch_utc}: {why}")


def _position_partials(epoch_utc: np.datetime64, state: Floats, t_utc: Times) -> Floats:
    """Return d(position)/d(state at the epoch), shape (3 n, 6), in the field of degree 2."""
    columns = []
    for k, size in enumerate((0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-4)):
        change = np.zeros(6)
        change[k] = size
        ends = [
            NumericalOrbit(epoch_utc, at[:3], at[3:], 2, False, rtol=1e-10).state_gcrf(t_utc)[0].ravel()
            for at in (state + change, state - change)
        ]
        columns.append((ends[0] - ends[1]) / (2.0 * size))
    return np.stack(columns, axis=1)
