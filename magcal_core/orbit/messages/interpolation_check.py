"""How far interpolation between the points of an ephemeris is from the orbit, and a better way where there is one.

Notes
-----
Where the velocities of the points agree with their positions, the Hermite polynomial of degree 11 through six points is
the orbit to compare with: each point is predicted from the others for that, and the error, scaled from the gap of two
steps to the middle of one, must be small against what is measured. Where they do not, each point is left out in turn:
the error of the file's own polynomial there, divided by the product of the distances to its nodes, is the derivative
that the polynomial lacks, and times that product elsewhere the error elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.numerics.interpolation import StateTable

Stamps = NDArray[np.int64]

BETTER_KM: Final = 0.3
"""Interpolation that is further off than this is done in a better way, or enters the error of the orbit, km."""
REFUSED_KM: Final = 10.0
"""An ephemeris whose interpolation is further off than this is refused, km."""
_DEGREE: Final = 11
_MOST_INTERVALS: Final = 4000
_PLACES: Final = (0.1, 0.3, 0.5, 0.7, 0.9)
_SMALL: Final = 0.1
"""A point predicted from the others must be off by less than this share of what is measured, or by `_NOTHING_KM`."""
_NOTHING_KM: Final = 0.05
_HIGHER: Final = 4
_HELD_OUT: Final = 4
"""Every fourth point is left out at a time."""


@dataclass(frozen=True, slots=True, eq=False)
class Interpolation:
    """How a table is interpolated, and how far that is off.

    Attributes
    ----------
    method, degree : ``LAGRANGE`` or ``HERMITE``, and its degree.
    starts_ns : int64, shape (k,)
        Where the intervals begin that were looked at.
    errors_km : shape (k,)
        Largest distance from the orbit in each, km.
    as_said_km : float
        The same, the median over the intervals, with the interpolation that the file asks for, km.
    """

    method: str
    degree: int
    starts_ns: Stamps
    errors_km: Floats
    as_said_km: float

    @property
    def typical_km(self) -> float:
        """Median over the intervals of how far interpolation is off at the most, km."""
        return float(np.median(self.errors_km)) if self.errors_km.size else 0.0

    def error_km(self, stamps_ns: Stamps) -> Floats:
        """Return how far interpolation is off at the most in the intervals of the times, km, shape (n,)."""
        if not self.errors_km.size:
            return np.zeros(len(stamps_ns))
        at = np.searchsorted(self.starts_ns, stamps_ns, side="right") - 1
        return self.errors_km[np.clip(at, 0, len(self.errors_km) - 1)]


def best_interpolation(table: StateTable, method: str, degree: int) -> Interpolation:
    """Return how ``table`` is interpolated best: as the file says, unless that is off and velocities allow better."""
    if len(table.stamps_ns) < 4:
        return Interpolation(method, degree, np.zeros(0, np.int64), np.zeros(0), 0.0)
    starts, at_ns = _between(table)
    said_km = table.hermite(at_ns, degree)[0] if method == "HERMITE" else table.lagrange(at_ns, degree)[0]
    better = min(_DEGREE, 2 * (len(table.stamps_ns) - 1) - 1)
    measured_km = _by_interval(np.linalg.norm(said_km - table.hermite(at_ns, better)[0], axis=1))
    predicted_km, own_km = _hermite_errors_km(table, better)
    if predicted_km <= max(_SMALL * float(np.median(measured_km)), _NOTHING_KM):
        as_said_km = float(np.median(measured_km))
        if measured_km.max() <= max(BETTER_KM, own_km):
            return Interpolation(method, degree, starts, measured_km, as_said_km)
        return Interpolation("HERMITE", better, starts, np.full(len(starts), own_km), as_said_km)
    if method == "HERMITE":
        # Its velocities are not those of its positions: what it predicts of its own points is what it is worth.
        errors_km = np.full(len(starts), predicted_km)
    else:
        errors_km = _by_interval(_lagrange_errors_km(table, degree, at_ns, said_km))
    return Interpolation(method, degree, starts, errors_km, float(np.median(errors_km)))


def _between(table: StateTable) -> tuple[Stamps, Stamps]:
    """Return where intervals between points begin, evenly chosen ones of long tables, and five instants in each."""
    first = np.unique(np.linspace(0, len(table.stamps_ns) - 2, _MOST_INTERVALS).astype(np.intp))
    start, step = table.stamps_ns[first], np.diff(table.stamps_ns)[first]
    places = start[:, None] + np.rint(np.array(_PLACES) * step[:, None]).astype(np.int64)
    return start, places.ravel()


def _by_interval(errors_km: Floats) -> Floats:
    largest: Floats = errors_km.reshape(-1, len(_PLACES)).max(axis=1)
    return largest


def _without(table: StateTable, first: int) -> tuple[StateTable, NDArray[np.intp]]:
    """Return the table without every fourth point from ``first`` on, and which points these are; the ends stay."""
    left_out = np.arange(first, len(table.stamps_ns) - 1, _HELD_OUT)
    kept = np.setdiff1d(np.arange(len(table.stamps_ns)), left_out)
    return StateTable(table.stamps_ns[kept], table.r_km[kept], table.v_km_s[kept]), left_out


def _hermite_errors_km(table: StateTable, degree: int) -> tuple[float, float]:
    """Return how far points are from their prediction by the others, and how far the polynomial is off between points.

    Both in km, the first the median over the points, the second the largest: a point that is left out stands in a gap
    of two steps, and the squared product of the distances to the nodes there against the one inside a step scales the
    error.
    """
    at_points: list[Floats] = []
    largest = 0.0
    steps_ns = np.diff(table.stamps_ns)
    for first in range(1, _HELD_OUT + 1):
        fewer, left_out = _without(table, first)
        use = min(degree, 2 * len(fewer.stamps_ns) - 1)
        if not left_out.size or use < 3:
            continue
        stamps, nodes = table.stamps_ns[left_out], (use + 1) // 2
        errors = np.linalg.norm(fewer.hermite(stamps, use)[0] - table.r_km[left_out], axis=1)
        beside = stamps + np.minimum(steps_ns[left_out - 1], steps_ns[left_out]) // 2
        ratio = (table.node_product(beside, nodes) / fewer.node_product(stamps, nodes)) ** 2
        at_points.append(errors)
        largest = max(largest, float((errors * ratio).max()))
    return (float(np.median(np.concatenate(at_points))), largest) if at_points else (np.inf, np.inf)


def _lagrange_errors_km(table: StateTable, degree: int, at_ns: Stamps, said_km: Floats) -> Floats:
    """Return how far the file's Lagrange polynomial, ``said_km``, is off at times, km, shape (n,).

    From one of four degrees more, where points left out say that it is much better; else from points left out alone.
    """
    higher = min(degree + _HIGHER, len(table.stamps_ns) - 1)
    left_out_km = _left_out_km(table, degree, at_ns)
    if higher > degree and _left_out_km(table, higher, at_ns).max() <= _SMALL * left_out_km.max():
        errors_km: Floats = np.linalg.norm(said_km - table.lagrange(at_ns, higher)[0], axis=1)
        return errors_km
    return left_out_km


def _left_out_km(table: StateTable, degree: int, at_ns: Stamps) -> Floats:
    """Return how far the Lagrange polynomial of a degree is off at times, km, shape (n,), from points left out."""
    lacking = np.full(len(table.stamps_ns), np.nan)
    for first in range(1, _HELD_OUT + 1):
        fewer, left_out = _without(table, first)
        if len(fewer.stamps_ns) <= degree or not left_out.size:
            continue
        stamps = table.stamps_ns[left_out]
        errors = np.linalg.norm(fewer.lagrange(stamps, degree)[0] - table.r_km[left_out], axis=1)
        lacking[left_out] = errors / fewer.node_product(stamps, degree + 1)
    known = np.flatnonzero(np.isfinite(lacking))
    if not known.size:
        return np.zeros(len(at_ns))
    near = np.interp(at_ns.astype(np.float64), table.stamps_ns[known].astype(np.float64), lacking[known])
    errors_km: Floats = near * table.node_product(at_ns, degree + 1)
    return errors_km
