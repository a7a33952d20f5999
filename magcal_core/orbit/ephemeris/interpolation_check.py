"""How far interpolation between the points of an ephemeris is from the orbit, and a better way where there is one.

Notes
-----
Where points left out are predicted from the others within a metre, that is the answer. Elsewhere the orbit to compare
with is the arc between two points that the forces allow, with both as its ends (`orbit.propagators.between_points`); it
does not hang on the velocities of the file, and what the file's polynomial or Hermite's of degree 11 gives beside it is
the error. Where arcs one after the other do not go on into each other (a manoeuvre, positions that scatter), points
tell: Hermite's polynomial where each point is predicted from the others, else each point left out in turn. The error of
the file's own polynomial there, divided by the product of the distances to its nodes, is the derivative that it lacks,
and times that product elsewhere the error elsewhere: right where points are dense on the scale of the orbit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Indices, Mask
from magcal_core.constants import EARTH_GM_KM3_S2
from magcal_core.errors import ModelRangeError
from magcal_core.numerics.interpolation import StateTable
from magcal_core.orbit.earth.frames import Frame, convert_position, convert_state

Stamps = NDArray[np.int64]

BETTER_KM: Final = 0.3
"""Interpolation that is further off than this is done in a better way, or enters the error of the orbit, km."""
REFUSED_KM: Final = 10.0
"""An ephemeris whose interpolation is further off than this is refused, km."""
_DEGREE: Final = 11
_MOST_INTERVALS: Final = 4000
_MOST_ARCS: Final = 1200
_PLAIN_KM: Final = 1e-3
"""What points left out tell to be less is believed."""
_PER_TURN: Final = 12.0
"""Fewer points in a turn than these do not tell by themselves what is between them."""
_PLACES: Final = (0.1, 0.3, 0.5, 0.7, 0.9)
_SMALL: Final = 0.1
"""A point predicted from the others must be off by less than this share of what is measured, or by `_NOTHING_KM`."""
_NOTHING_KM: Final = 0.05
_DOUBT: Final = 0.2
"""Arcs that can be off by less than this share of what is measured beside them, or by `_SLIGHT_KM`, are believed."""
_DOUBT_OF_FEW: Final = 0.5
"""The same where points are not dense."""
_SLIGHT_KM: Final = 0.005
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
    astray : bool, shape (k,)
        Where the points are not those of an orbit under known forces, by more than `BETTER_KM` in the middle of an
        interval: there the errors are from points left out, and can be wrong by a factor.
    """

    method: str
    degree: int
    starts_ns: Stamps
    errors_km: Floats
    as_said_km: float
    astray: Mask

    @property
    def typical_km(self) -> float:
        """Median over the intervals of how far interpolation is off at the most, km."""
        return float(np.median(self.errors_km)) if self.errors_km.size else 0.0

    def error_km(self, stamps_ns: Stamps) -> Floats:
        """Return how far interpolation is off at the most in the intervals of the times, km, shape (n,)."""
        return self.errors_km[self._interval(stamps_ns)] if self.errors_km.size else np.zeros(len(stamps_ns))

    def is_astray(self, stamps_ns: Stamps) -> Mask:
        """Return whether the points about the times are not those of an orbit under known forces, shape (n,)."""
        return self.astray[self._interval(stamps_ns)] if self.astray.size else np.zeros(len(stamps_ns), np.bool_)

    def _interval(self, stamps_ns: Stamps) -> Indices:
        at = np.searchsorted(self.starts_ns, stamps_ns, side="right") - 1
        return np.clip(at, 0, len(self.starts_ns) - 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Errors in the intervals that begin at points, km: as the file says, and by Hermite's polynomial, inf: unknown."""

    first: Indices
    as_said_km: Floats
    better_km: Floats
    astray: Mask

    def interpolation(self, table: StateTable, method: str, degree: int, better: int) -> Interpolation:
        """Return the way that the file says, unless it is off and Hermite's polynomial is not, or less."""
        starts, as_said_km = table.stamps_ns[self.first], float(np.median(self.as_said_km))
        if self.as_said_km.max() <= max(BETTER_KM, self.better_km.max()):
            return Interpolation(method, degree, starts, self.as_said_km, as_said_km, self.astray)
        return Interpolation("HERMITE", better, starts, self.better_km, as_said_km, self.astray)


def best_interpolation(table: StateTable, method: str, degree: int, frame: Frame = "GCRF") -> Interpolation:
    """Return how ``table``, in ``frame``, is interpolated best: as the file says, unless that is off."""
    count = len(table.stamps_ns)
    if count < 4:
        nothing = np.zeros(0)
        return Interpolation(method, degree, np.zeros(0, np.int64), nothing, 0.0, nothing.astype(np.bool_))
    better = min(_DEGREE, 2 * (count - 1) - 1)
    errors = _by_points(table, method, degree, better)
    if errors.as_said_km.max() > _PLAIN_KM or not _is_dense(table):
        errors = _by_forces(table, method, degree, better, frame=frame, points=errors)
    return errors.interpolation(table, method, degree, better)


def _is_dense(table: StateTable) -> bool:
    """Return whether points are so near to each other, for the lowest of them, that they tell what is between them."""
    turn_s = 2.0 * np.pi * np.sqrt(np.linalg.norm(table.r_km, axis=1).min() ** 3 / EARTH_GM_KM3_S2)
    return bool(_PER_TURN * float(np.median(np.diff(table.stamps_ns))) / 1e9 <= turn_s)


def _said(table: StateTable, method: str, degree: int, at_ns: Stamps) -> Floats:
    return table.hermite(at_ns, degree)[0] if method == "HERMITE" else table.lagrange(at_ns, degree)[0]


def _by_points(table: StateTable, method: str, degree: int, better: int) -> _Errors:
    """Return the errors as points that are left out tell them."""
    first, at_ns = _between(table, _MOST_INTERVALS)
    unknown, nowhere = np.full(len(first), np.inf), np.zeros(len(first), np.bool_)
    said_km = _said(table, method, degree, at_ns)
    measured_km = _by_interval(np.linalg.norm(said_km - table.hermite(at_ns, better)[0], axis=1))
    predicted_km, own_km = _hermite_errors_km(table, better)
    if predicted_km <= max(_SMALL * float(np.median(measured_km)), _NOTHING_KM):
        return _Errors(first, measured_km, np.full(len(first), own_km), nowhere)
    if method == "HERMITE":
        # Its velocities are not those of its positions: what it predicts of its own points is what it is worth.
        return _Errors(first, np.full(len(first), predicted_km), unknown, nowhere)
    return _Errors(first, _by_interval(_lagrange_errors_km(table, degree, at_ns, said_km)), unknown, nowhere)


def _by_forces(table: StateTable, method: str, degree: int, better: int, *, frame: Frame, points: _Errors) -> _Errors:
    """Return the errors beside the arcs of the forces, and those of ``points`` where there is no arc."""
    from magcal_core.orbit.propagators.between_points import arcs_between

    first, at_ns = _between(table, _MOST_ARCS)
    try:
        inertial = _in_gcrf(table, frame)
    except ModelRangeError:
        # The Earth's orientation is not known at these times, so that the file cannot be used at them either.
        return points
    arcs = arcs_between(table.stamps_ns, inertial.r_km, inertial.v_km_s, first, np.array(_PLACES))
    true_km = arcs.r_km.reshape(-1, 3)
    if frame != "GCRF":
        true_km = convert_position(at_ns.view("datetime64[ns]"), true_km, "GCRF", frame)
    as_said_km, better_km = (
        _by_interval(np.linalg.norm(one - true_km, axis=1))
        for one in (_said(table, method, degree, at_ns), table.hermite(at_ns, better)[0])
    )
    near = np.clip(np.searchsorted(points.first, first, side="right") - 1, 0, len(points.first) - 1)
    is_dense, kept = _is_dense(table), []
    for own, other in ((as_said_km, points.as_said_km[near]), (better_km, points.better_km[near])):
        # Of points that are dense those left out tell the error; of others they can be wrong by any factor.
        bound = np.maximum(own, arcs.misfit_km)
        doubtful = np.where(np.isfinite(bound), np.minimum(bound, other) if is_dense else bound, other)
        doubt = _DOUBT if is_dense else _DOUBT_OF_FEW
        kept.append(np.where(arcs.misfit_km <= np.maximum(doubt * own, _SLIGHT_KM), own, doubtful))
    if not table.v_km_s.any():
        kept[1][:] = np.inf
    return _Errors(first, kept[0], kept[1], ~(arcs.misfit_km <= BETTER_KM))


def _in_gcrf(table: StateTable, frame: Frame) -> StateTable:
    """Return the table in GCRF; velocities of 0, which are none, stay 0."""
    if frame == "GCRF":
        return table
    t_utc = table.stamps_ns.view("datetime64[ns]")
    r_km, v_km_s = convert_state(t_utc, table.r_km, table.v_km_s, frame, "GCRF")
    return StateTable(table.stamps_ns, r_km, v_km_s if table.v_km_s.any() else table.v_km_s)


def _between(table: StateTable, most: int) -> tuple[Indices, Stamps]:
    """Return the points at which intervals begin, and five instants in each interval.

    Of long tables evenly chosen ones, three in a row, since neighbours are compared.
    """
    count = len(table.stamps_ns) - 1
    first = np.arange(count)
    if count > most:
        middle = np.linspace(1, count - 2, most // 3).astype(np.intp)
        first = np.unique(middle[:, None] + np.arange(-1, 2))
    start, step = table.stamps_ns[first], np.diff(table.stamps_ns)[first]
    places = start[:, None] + np.rint(np.array(_PLACES) * step[:, None]).astype(np.int64)
    return first, places.ravel()


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
