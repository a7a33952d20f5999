"""The orbit between given positions, by the forces: the arcs of which the points of an ephemeris are the ends.

Notes
-----
An arc is the solution of the boundary value problem: from one position, at the speed that leads to the next one. It is
found by shooting; the start is the velocity that is known, or Lambert's for the attraction of a point (BMW, 5.3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from magcal_core.arrays import Floats, Indices, Nanoseconds
from magcal_core.constants import EARTH_GM_KM3_S2
from magcal_core.errors import ModelRangeError, TimeError
from magcal_core.orbit.earth.bodies import default_ephemeris
from magcal_core.orbit.propagators import dop853
from magcal_core.orbit.propagators.forces import NODE_S, force_model, force_tables
from magcal_core.orbit.propagators.gravity import GravityField, egm96

Kind = Literal["whole", "zonal", "point"]

_DEGREE: Final = 8
"""Of the gravity field; what is above it moves an arc of half an hour by a metre."""
_RTOL: Final = 1e-10
_ATOL_KM: Final = 1e-7
_ATOL_KM_S: Final = 1e-10
_MOST_STEPS: Final = 2000
_ROUNDS: Final = 6
_MET_KM: Final = 1e-4
"""An arc that ends so near to its point is found."""
_NUDGE: Final = 1e-5
"""Share of the speed by which it is changed to see where the arc ends then."""
_WEAK: Final = 0.05
"""Directions of the speed that move the end by less than this share of the strongest are left as they are."""
_FLAT: Final = 0.15
"""Sine of the angle between two positions below which they do not tell the plane of the orbit."""
_BISECTIONS: Final = 60
_FITS_KM: Final = 1e-4
"""Arcs that fit each other better than this were made of these forces."""
_TRIED: Final = 8
_KINDS: Final[tuple[Kind, ...]] = ("whole", "zonal", "point")
_ANY_EPOCH: Final = np.datetime64("2000-01-01", "ns")


@dataclass(frozen=True, slots=True, eq=False)
class Arcs:
    """Arcs between positions, all GCRF.

    Attributes
    ----------
    r_km : shape (n, p, 3)
        Positions at the shares of the time that were asked for; NaN where no arc was found.
    leaves_km_s, arrives_km_s : shape (n, 3)
        Velocities at both ends.
    misfit_km : shape (n,)
        How far the arc can be off in its middle, seen by the jumps of the velocity between it and its neighbours:
        other forces, a manoeuvre, or positions that scatter. NaN where no arc was found.
    """

    r_km: Floats
    leaves_km_s: Floats
    arrives_km_s: Floats
    misfit_km: Floats


def arcs_between(stamps_ns: Nanoseconds, r_km: Floats, v_km_s: Floats, first: Indices, shares: Floats) -> Arcs:
    """Return the arcs that begin at the points ``first`` and end at the next ones.

    Parameters
    ----------
    stamps_ns : int64, shape (k,)
        UTC.
    r_km, v_km_s : shape (k, 3)
        GCRF; velocities of 0, and others that do not lead from point to point, count as unknown.
    first : shape (n,)
        Ascending; arcs one after the other are compared with each other.
    shares : shape (p,)
        Where positions are wanted, from 0 at the beginning of an arc to 1 at its end.

    Notes
    -----
    Of three kinds of forces those are taken under which arcs go on into each other best: gravity to degree 8 with Sun
    and Moon, its zonal part alone (as SGP4 has it), and the attraction of a point (as in studies).
    """
    starts = _starts(stamps_ns, r_km, v_km_s, first)
    tried = _some(len(first))
    best, least = _KINDS[0], (len(tried) + 1, np.inf)
    for kind in _KINDS:
        worth = _worth(_shot(stamps_ns, r_km, starts[tried], first[tried], shares=shares[:0], kind=kind))
        if worth < least:
            best, least = kind, worth
        if worth < (1, _FITS_KM):
            break
    return _shot(stamps_ns, r_km, starts, first, shares=shares, kind=best)


def _some(count: int) -> Indices:
    """Return some of ``count`` arcs, in three runs."""
    begins = np.linspace(0, max(count - _TRIED, 0), 3).astype(np.intp)
    return np.unique(np.minimum(begins[:, None] + np.arange(_TRIED), count - 1))


def _worth(arcs: Arcs) -> tuple[int, float]:
    """Return how little arcs are worth: how many were not found, and the typical misfit of the others."""
    lacking = np.isnan(arcs.misfit_km)
    return int(lacking.sum()), np.inf if lacking.all() else float(np.median(arcs.misfit_km[~lacking]))


def _gravity(kind: Kind) -> GravityField:
    """Return the gravity field of a kind of forces."""
    if kind == "point":
        return egm96(0)
    field = egm96(_DEGREE)
    if kind == "whole":
        return field
    zonal = np.zeros_like(field.c)
    zonal[:, 0] = field.c[:, 0]
    return replace(field, c=zonal, s=np.zeros_like(field.s))


def _starts(stamps_ns: Nanoseconds, r_km: Floats, v_km_s: Floats, first: Indices) -> Floats:
    """Return velocities with which to begin, shape (n, 3), km/s: those that are known, else Lambert's."""
    time_s = np.diff(stamps_ns) / 1e9
    leaves, arrives, sine = _lambert(r_km[:-1], r_km[1:], time_s)
    known = v_km_s[first]
    radius, speed = np.linalg.norm(r_km[first], axis=1), np.linalg.norm(known, axis=1)
    is_bound = (speed > 0.0) & (speed < np.sqrt(2.0 * EARTH_GM_KM3_S2 / radius))
    chord = (r_km[first + 1] - r_km[first]) / time_s[first, None]
    if is_bound.all() and _leads(r_km, known, time_s, first, chord):
        return known
    starts = leaves[first]
    # Two positions in line with the Earth's centre do not tell the plane: the velocity goes on from the arc before.
    for i in np.flatnonzero(np.abs(sine[first]) < _FLAT):
        before = first[i] - 1
        if before >= 0 and np.abs(sine[before]) >= _FLAT:
            starts[i] = arrives[before]
    return starts


def _leads(r_km: Floats, known: Floats, time_s: Floats, first: Indices, chord: Floats) -> bool:
    """Return whether known velocities lead from point to point: most are those of Lambert's arcs, whichever way round.

    An arc of a known velocity is Kepler's; where that ends is compared with the next point.
    """
    at = np.unique(np.linspace(0, len(first) - 1, 24).astype(np.intp))
    rows = first[at]
    off = np.linalg.norm(_kepler(r_km[rows], known[at], time_s[rows]) - r_km[rows + 1], axis=1)
    way = time_s[rows] * np.maximum(np.linalg.norm(chord[at], axis=1), np.linalg.norm(known[at], axis=1))
    return bool(np.median(off / way) < 0.05)


def _stumpff(z: Floats) -> tuple[Floats, Floats]:
    """Return Stumpff's functions C and S of ``z``, which is above 0 on an ellipse."""
    root = np.sqrt(np.maximum(np.abs(z), 1e-12))
    is_near = np.abs(z) < 1e-4
    near = 0.5 - z / 24.0 + z * z / 720.0, 1.0 / 6.0 - z / 120.0 + z * z / 5040.0
    safe = np.minimum(root, 50.0)
    circular = (1.0 - np.cos(root)) / root**2, (root - np.sin(root)) / root**3
    hyperbolic = (np.cosh(safe) - 1.0) / safe**2, (np.sinh(safe) - safe) / safe**3
    c, s = (
        np.where(is_near, one, np.where(z > 0.0, two, three))
        for one, two, three in zip(near, circular, hyperbolic, strict=True)
    )
    return c, s


def _lambert(r1_km: Floats, r2_km: Floats, time_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the velocities at both ends of arcs of less than a turn, (n, 3) each, km/s, and the sine of their angles.

    All go round the Earth the same way: that of most of the arcs, if these are shorter than half a turn.
    """
    r1, r2 = np.linalg.norm(r1_km, axis=1), np.linalg.norm(r2_km, axis=1)
    normal = np.cross(r1_km, r2_km) / (r1 * r2)[:, None]
    axis = _axis(normal)
    cosine = np.einsum("ni,ni->n", r1_km, r2_km) / (r1 * r2)
    sine = np.linalg.norm(normal, axis=1) * np.where(normal @ axis >= 0.0, 1.0, -1.0)
    a = sine * np.sqrt(r1 * r2 / np.maximum(1.0 - cosine, 1e-12))
    low, high = np.full(len(r1), -4.0 * np.pi**2), np.full(len(r1), 4.0 * np.pi**2)
    y = np.ones_like(r1)
    for _ in range(_BISECTIONS):
        z = 0.5 * (low + high)
        c, s = _stumpff(z)
        y = r1 + r2 + a * (z * s - 1.0) / np.sqrt(c)
        held = np.maximum(y, 0.0)
        takes_s = ((held / c) ** 1.5 * s + a * np.sqrt(held)) / np.sqrt(EARTH_GM_KM3_S2)
        is_short = (y < 0.0) | (takes_s < time_s)
        low, high = np.where(is_short, z, low), np.where(is_short, high, z)
    y = np.maximum(y, 1e-9)
    g = a * np.sqrt(y / EARTH_GM_KM3_S2)
    g = np.where(np.abs(g) < 1e-9, 1e-9, g)[:, None]
    leaves = (r2_km - (1.0 - y / r1)[:, None] * r1_km) / g
    arrives = ((1.0 - y / r2)[:, None] * r2_km - r1_km) / g
    return leaves, arrives, sine


def _axis(normals: Floats) -> Floats:
    """Return the direction about which most arcs turn, shape (3,)."""
    axis: Floats = normals[int(np.argmax(np.linalg.norm(normals, axis=1)))]
    sides = np.sign(normals @ axis)
    return axis if sides.sum() >= 0.0 else -axis


def _kepler(r_km: Floats, v_km_s: Floats, time_s: Floats) -> Floats:
    """Return positions ``time_s`` later on Kepler's ellipses, shape (n, 3), km."""
    r = np.linalg.norm(r_km, axis=1)
    radial = np.einsum("ni,ni->n", r_km, v_km_s) / np.sqrt(EARTH_GM_KM3_S2)
    alpha = 2.0 / r - np.einsum("ni,ni->n", v_km_s, v_km_s) / EARTH_GM_KM3_S2
    x = np.sqrt(EARTH_GM_KM3_S2) * alpha * time_s
    for _ in range(50):
        c, s = _stumpff(alpha * x * x)
        value = radial * x**2 * c + (1.0 - alpha * r) * x**3 * s + r * x - np.sqrt(EARTH_GM_KM3_S2) * time_s
        slope = radial * x * (1.0 - alpha * x * x * s) + (1.0 - alpha * r) * x**2 * c + r
        x = x - value / slope
    c, s = _stumpff(alpha * x * x)
    f = 1.0 - x**2 / r * c
    g = time_s - x**3 * s / np.sqrt(EARTH_GM_KM3_S2)
    out: Floats = f[:, None] * r_km + g[:, None] * v_km_s
    return out


class _Forces:
    """The forces over all arcs; times are seconds since the first one's beginning."""

    def __init__(self, begin_ns: int, span_s: float, kind: Kind) -> None:
        field = _gravity(kind)
        try:
            epoch = np.datetime64(begin_ns, "ns")
            self._tables = force_tables(epoch, -NODE_S, span_s + NODE_S, default_ephemeris())
            self._model = force_model(field, third_bodies=kind == "whole")
        except (ModelRangeError, TimeError):
            # Before and beyond the tables of Earth orientation: zonal gravity is what counts between two points.
            self._tables = force_tables(_ANY_EPOCH, -NODE_S, span_s + NODE_S, "erfa", "uniform")
            self._model = force_model(field, third_bodies=False)

    def states(self, begin_s: float, state: Floats, at_s: Floats) -> Floats | None:
        """Return the states at ``at_s``, the last of which is the farthest, shape (p, 6); None where it cannot."""
        step_s = min(0.25 * (at_s[-1] - begin_s), 60.0)
        n, t_s, y, polynomial, _, status = dop853.integrate(
            begin_s, state, step_s, at_s[-1], _RTOL, _ATOL_KM, _ATOL_KM_S, _MOST_STEPS, self._tables, self._model
        )
        if status != dop853.DONE:
            return None
        return np.asarray(dop853.evaluate(at_s, t_s[: n + 1], y[: n + 1], polynomial[:n]))


def _shot(
    stamps_ns: Nanoseconds, r_km: Floats, starts: Floats, first: Indices, *, shares: Floats, kind: Kind
) -> Arcs:  # fmt: skip
    """Return the arcs under a kind of forces."""
    since_s = (stamps_ns - stamps_ns[first[0]]) / 1e9
    forces = _Forces(int(stamps_ns[first[0]]), float(since_s[first[-1] + 1]), kind)
    places = np.full((len(first), len(shares), 3), np.nan)
    leaves, arrives = np.full((len(first), 3), np.nan), np.full((len(first), 3), np.nan)
    for i, point in enumerate(first):
        found = _one(forces, since_s[point : point + 2], r_km[point : point + 2], starts[i], shares)
        if found is not None:
            places[i], leaves[i], arrives[i] = found
    return Arcs(places, leaves, arrives, _misfit_km(np.diff(since_s)[first], leaves, arrives, first))


def _one(
    forces: _Forces, ends_s: Floats, ends_km: Floats, start_km_s: Floats, shares: Floats
) -> tuple[Floats, Floats, Floats] | None:
    """Return positions within an arc and the velocities at its ends, None where none is found."""
    at_s = np.append(ends_s[0] + shares * (ends_s[1] - ends_s[0]), ends_s[1])
    leaves, turn = start_km_s, None
    for _ in range(_ROUNDS):
        states = forces.states(ends_s[0], np.concatenate([ends_km[0], leaves]), at_s)
        if states is None:
            return None
        off_km = states[-1, :3] - ends_km[1]
        if np.linalg.norm(off_km) < _MET_KM:
            break
        if turn is None:
            turn = _answer(forces, ends_s, ends_km[0], leaves, states[-1, :3])
            if turn is None:
                return None
        leaves = leaves - turn @ off_km
    else:
        return None
    return states[:-1, :3] - shares[:, None] * off_km, leaves, states[-1, 3:]


def _answer(forces: _Forces, ends_s: Floats, r_km: Floats, speed: Floats, end_km: Floats) -> Floats | None:
    """Return by how much the velocity must change for each km of the end, shape (3, 3), 1/s."""
    nudge = _NUDGE * float(np.linalg.norm(speed))
    columns = []
    for axis in range(3):
        moved = speed.copy()
        moved[axis] += nudge
        states = forces.states(ends_s[0], np.concatenate([r_km, moved]), ends_s[1:])
        if states is None:
            return None
        columns.append((states[-1, :3] - end_km) / nudge)
    return np.asarray(np.linalg.pinv(np.stack(columns, axis=1), rcond=_WEAK))


def _misfit_km(step_s: Floats, leaves: Floats, arrives: Floats, first: Indices) -> Floats:
    """Return the largest effect of the jumps at an arc's ends in its middle, jump x time / 8, shape (n,), km."""
    jumps = np.full(len(first) + 1, np.nan)
    follows = np.diff(first) == 1
    jumps[1:-1] = np.where(follows, np.linalg.norm(leaves[1:] - arrives[:-1], axis=1), np.nan)
    both = np.stack([jumps[:-1], jumps[1:]], axis=1)
    is_known = np.isfinite(both).any(axis=1) & np.isfinite(leaves).all(axis=1)
    largest = np.where(is_known, np.nanmax(np.where(np.isfinite(both), both, -np.inf), axis=1), np.nan)
    out: Floats = largest * step_s / 8.0
    return out
