"""Columns of time that an error of the bias may follow: the orbit, the heat of the sun, the sun on panels, a drift.

Notes
-----
Families of columns, each centred over the samples that have weight and of unit root mean square, times each axis of the
bias: `orbit`, cosine and sine of the orbital period and of half of it, over more than four orbits the first pair times
the time from the middle as well; `heat`, light (1 in the sun, 0 in the umbra, a cylinder of 6378 km) and light through
y' = (light - y) / tau; `sun`, light times the sun's direction in the sensor's frame and times its size, axis by axis.
Without attitude the direction is replaced by its part along the field: c u, c the cosine of field and sun, u the
direction of the corrected reading. `drift`, over more than a day: a line in time. It does not follow the orbit, but
passes of minutes, hours apart, take a bias that drifts for one that does: over days its line is far larger than
anything else. Of less than a day real telemetry is no better for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask, Times
from magcal_core.attitude.rotation import rotate_rows
from magcal_core.calibration.terms.heat_columns import heat_columns, light_of, places_itrf_km, sun_gcrf
from magcal_core.calibration.terms.locked_posterior import DRIFT, LockedFamilies
from magcal_core.constants import EARTH_ROTATION_RAD_S
from magcal_core.errors import ModelRangeError
from magcal_core.field import FieldModel
from magcal_core.numerics.vectors import lengths
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples

FAMILIES: Final = ("orbit", "heat", "sun", DRIFT)
MANY_ORBITS: Final = 4.0
"""Orbits from which on the amplitude of a wave may change over the session."""
DRIFTS_S: Final = 86400.0
"""Length of a session, s, from which on its bias may drift."""
_LEAST_SPREAD: Final = 1e-3
"""Standard deviation below which a column is constant."""
MOST_UNSEEN: Final = 4.0
"""Largest ratio of the sun's square across the field to that along it that is believed."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What is known of place and sun at each sample.

    Attributes
    ----------
    period_s : float or None
        Mean orbital period, s.
    light : shape (n,), optional
        1 in the sun, 0 in the umbra.
    sun_base : shape (n, 3), optional
        Direction of the sun in the base frame, where attitude is known.
    cosine : shape (n,), optional
        Cosine of the angle of the model's field and the sun, where it is not.
    heat : shape (n, 2), optional
        Light with a delay (`heat_columns`), where light is known.
    """

    period_s: float | None
    light: Floats | None = None
    sun_base: Floats | None = None
    cosine: Floats | None = None
    heat: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LockedColumns:
    """Columns of time, shape (n, t), with the family of each.

    ``unseen``: mean square of the sun across the field over that along it, at most `MOST_UNSEEN`; 0 where attitude is
    known.
    """

    columns: Floats
    families: tuple[str, ...]
    unseen: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """The families that there are, in the order of `FAMILIES`."""
        return tuple(name for name in FAMILIES if name in self.families)

    @property
    def family_of_terms(self) -> NDArray[np.intp]:
        """Return the family, from 0, of every column times axis, shape (3 t,)."""
        of_column = [self.names.index(name) for name in self.families]
        return np.repeat(np.array(of_column, np.intp), 3)

    @property
    def locked_families(self) -> LockedFamilies:
        """Which family each term is of."""
        return LockedFamilies(self.names, self.family_of_terms, self.unseen)

    def only(self, names: Sequence[str]) -> LockedColumns:
        """Return the columns of these families alone."""
        kept = [i for i, name in enumerate(self.families) if name in names]
        return LockedColumns(self.columns[:, kept], tuple(self.families[i] for i in kept), self.unseen)


def no_columns(samples: int) -> LockedColumns:
    """Return the columns of a session of which nothing is known that a bias could be locked to."""
    return LockedColumns(np.zeros((samples, 0)), ())


def surroundings_of(
    samples: Samples, orbits: Sequence[Orbit], field: FieldModel, *, needs_cosine: bool = True
) -> Surroundings:
    """Return what is known of place and sun at ``samples``, whose orbits are ``orbits``.

    ``needs_cosine``: whether the angle of field and sun is asked for where no attitude is known.
    """
    period_s = orbital_period_s(samples, orbits)
    r_km = samples.r_itrf_km
    if r_km is None:
        r_km = places_itrf_km(samples.t_utc, orbits)
    if r_km is None or not np.isfinite(r_km).all() or len(samples) < 2:
        return Surroundings(period_s)
    sun = sun_gcrf(samples.t_utc)
    r_gcrf_km = itrf_to_gcrf_fast(samples.t_utc, r_km)
    light = light_of(r_gcrf_km, sun)
    heat = heat_columns(samples.t_utc, light, orbits)
    q = samples.q_base_gcrf
    if q is not None and np.isfinite(q).all():
        return Surroundings(period_s, light, rotate_rows(q, np.ascontiguousarray(sun)), None, heat)
    b_nt = samples.b_ref_gcrf_nt
    if not needs_cosine:
        return Surroundings(period_s, light, None, None, heat)
    if b_nt is None or not np.isfinite(b_nt).all():
        try:
            b_nt = itrf_to_gcrf_fast(samples.t_utc, field.field_itrf_nt(samples.t_utc, r_km))
        except ModelRangeError:
            return Surroundings(period_s, light, None, None, heat)
    return Surroundings(period_s, light, None, np.einsum("ni,ni->n", b_nt, sun) / lengths(b_nt), heat)


def locked_columns(
    t_s: Floats, around: Surroundings, unit: Floats, used: Mask, *, has_time: bool = False
) -> LockedColumns | None:
    """Return the columns of all families that there are; None where nothing is known to be locked to.

    Parameters
    ----------
    t_s : shape (n,)
        Time of the samples, s, ascending.
    around : Surroundings
    unit : shape (n, 3)
        Direction of the corrected reading, for the sun's part along the field.
    used : shape (n,)
        Samples that have weight: the columns are centred over them.
    has_time : bool
        Whether a line in time is an unknown of the fit itself.
    """
    made: list[tuple[str, Floats]] = []
    unseen = 0.0
    if around.period_s is not None:
        made += [("orbit", column) for column in _orbit_columns(t_s, around.period_s)]
    if around.light is not None:
        made += [("heat", around.light)]
        made += [("heat", column) for column in (np.zeros((0, 0)) if around.heat is None else around.heat).T]
        towards = around.sun_base
        if towards is None and around.cosine is not None:
            towards, unseen = around.cosine[:, None] * unit, _unseen(around.light, around.cosine, used)
        if towards is not None:
            lit = around.light[:, None]
            made += [("sun", column) for column in (lit * towards).T] + [
                ("sun", column) for column in (lit * np.abs(towards)).T
            ]
    if not has_time and made and t_s[-1] - t_s[0] > DRIFTS_S:
        made += [(DRIFT, t_s)]
    columns, families = [], []
    for name, column in made:
        centred = column - column[used].mean()
        spread = float(np.sqrt(np.mean(centred[used] ** 2)))
        if spread >= _LEAST_SPREAD:
            columns.append(centred / spread)
            families.append(name)
    return LockedColumns(np.column_stack(columns), tuple(families), unseen) if columns else None


def _orbit_columns(t_s: Floats, period_s: float) -> list[Floats]:
    """Return cosine and sine of one and two turns an orbit, and of one growing over a session of many orbits."""
    middle, half_s = 0.5 * float(t_s[0] + t_s[-1]), max(0.5 * float(t_s[-1] - t_s[0]), 1.0)
    turns = 2.0 * np.pi * (t_s - middle) / period_s
    once, twice = (np.cos(turns), np.sin(turns)), (np.cos(2.0 * turns), np.sin(2.0 * turns))
    columns = [*once, *twice]
    if 2.0 * half_s > MANY_ORBITS * period_s:
        columns += [(t_s - middle) / half_s * wave for wave in once]
    return columns


def _unseen(light: Floats, cosine: Floats, used: Mask) -> float:
    """Return the mean square of the sun across the field over that along it."""
    along = float(np.mean((light * cosine**2)[used]))
    across = float(np.mean((light * (1.0 - cosine**2))[used]))
    return min(across / max(along, 1e-12), MOST_UNSEEN) if across > 0 else 0.0


def orbital_period_s(samples: Samples, orbits: Sequence[Orbit]) -> float | None:
    """Return the mean orbital period, s: that of the elements, or else of the positions' argument of latitude.

    None where neither is known.
    """
    for orbit in orbits:
        if isinstance(orbit, Sgp4Orbit):
            return float(2.0 * np.pi / (orbit.elements.satrec().no_kozai / 60.0))
    r_km = samples.r_itrf_km
    if r_km is None:
        return None
    known = np.isfinite(r_km).all(axis=1)
    return _period_of_positions(samples.t_utc[known], r_km[known])


def _period_of_positions(t_utc: Times, r_km: Floats) -> float | None:
    """Return 2 pi over the mean rate of the argument of latitude; None where no two positions are near each other."""
    step = max(1, len(t_utc) // 20_000)
    t_s = (t_utc[::step] - t_utc[0]) / np.timedelta64(1, "s")
    angle = EARTH_ROTATION_RAD_S * t_s
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = r_km[::step].T
    r = np.column_stack([c * x - s * y, s * x + c * y, z])
    r /= np.linalg.norm(r, axis=1)[:, None]
    gaps = np.diff(t_s)
    turned = np.arccos(np.clip(np.einsum("ni,ni->n", r[1:], r[:-1]), -1.0, 1.0))
    is_near = (gaps > 0) & (gaps < 900.0) & (turned > 0)
    if not is_near.any():
        return None
    normal = np.cross(r[:-1], r[1:])[is_near].sum(axis=0)
    normal /= np.linalg.norm(normal)
    rate = float(turned[is_near].sum() / gaps[is_near].sum())
    node = np.cross([0.0, 0.0, 1.0], normal)
    node = node / np.linalg.norm(node) if np.linalg.norm(node) > 1e-6 else np.array([1.0, 0.0, 0.0])
    latitude = np.arctan2(r @ np.cross(normal, node), r @ node)
    expected = rate * t_s
    ahead = np.unwrap(latitude - expected)
    slope = float(np.polyfit(t_s, ahead, 1)[0]) if t_s[-1] > np.pi / rate else 0.0
    return float(2.0 * np.pi / (rate + slope))
