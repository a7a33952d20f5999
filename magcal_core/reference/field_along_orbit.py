"""The field along one orbit, which is a smooth function of time alone: at nodes, polynomials between.

Notes
-----
Harmonics of degree 13 pass a low satellite as thirteen waves a turn. Nodes 0.07 rad of the way at the perigee apart, 59
s at 200 km, leave 0.0005 nT there and 0.003 nT at the perigee of eccentric orbits. Each polynomial is compared with the
field itself at a place of its own: where it is 0.005 nT away or more (an ephemeris with corners, a leap second), and
where a node has no field, the samples are asked for one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds, Times
from magcal_core.constants import EARTH_ROTATION_RAD_S
from magcal_core.errors import IndexRangeError, ModelRangeError, OrbitFormatError, OrbitMissingError, PropagationError
from magcal_core.field import FieldModel
from magcal_core.field.file_model import FileField
from magcal_core.field.igrf import MAX_DEGREE, Igrf
from magcal_core.field.summed import SummedField
from magcal_core.numerics.vectors import lengths
from magcal_core.orbit import Orbit
from magcal_core.orbit.choose import BoundedOrbit
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.orbit.messages.elements import elements_from_state
from magcal_core.orbit.propagators.dense import MIN_SAMPLES, Polynomials, interval_ns, polynomials, times_needed

Rows = NDArray[np.intp] | slice

SAMPLES_PER_NODE: Final = 8
"""Interpolate where there are at least this many samples for each node, which costs an orbit and two fields."""
TOLERANCE_NT: Final = 0.005
"""Largest component of a polynomial's error at the place where it is checked."""
_TURN_RAD: Final = 0.07
_ROWS: Final = 1 << 18
"""Samples whose field is taken at a time: more would keep vectors that nobody asks for."""
_ROWS_INTERPOLATED: Final = 1 << 14
"""The same where it is interpolated: these vectors stay in the cache."""
_CORNERS_AROUND: Final = 8
"""Intervals before the first and after the last sample in which a corner counts: polynomials reach that far."""
_MOST_ROUGH: Final = 0.5
"""Part of the intervals without a polynomial from which on none is used."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretches:
    """Polynomials of a field that has corners in time: others before each corner than after it.

    Attributes
    ----------
    corners_ns : shape (k,)
    between : tuple of k + 1 Polynomials, None where no sample is.
    """

    corners_ns: Nanoseconds
    between: tuple[Polynomials | None, ...]

    @property
    def gap_fraction(self) -> float:
        """Part of the intervals with samples that have no polynomial."""
        found = [pieces for pieces in self.between if pieces is not None]
        counts = [len(pieces.coefficients) for pieces in found]
        gaps = [pieces.gap_fraction * count for pieces, count in zip(found, counts, strict=True)]
        return sum(gaps) / sum(counts) if found else 1.0

    def at(self, stamps_ns: Nanoseconds) -> Floats:
        """Return the function at ``stamps_ns``, shape (n, 3); NaN where no polynomial holds."""
        values = np.full((len(stamps_ns), 3), np.nan)
        which = np.searchsorted(self.corners_ns, stamps_ns, side="right")
        for number in np.unique(which):
            pieces = self.between[number]
            if pieces is not None:
                rows = np.flatnonzero(which == number)
                values[rows] = pieces.at(stamps_ns[rows])
        return values


@dataclass(frozen=True, slots=True, eq=False)
class FieldAlong:
    """The field of a model along an orbit, in GCRF or else in ITRF; by polynomials where there are some."""

    orbit: Orbit
    field: FieldModel
    is_gcrf: bool
    pieces: Polynomials | Stretches

    def at(self, t_utc: Times) -> Floats:
        """Return the field at ``t_utc``, shape (n, 3), nT, within 0.01 nT of the model's at the orbit's position."""
        b_nt = self.pieces.at(nanoseconds(t_utc))
        if len(rough := np.flatnonzero(np.isnan(b_nt[:, 0]))):
            t_rough = t_utc[rough]
            b_nt[rough] = field_at(self.field, t_rough, positions_km(self.orbit, t_rough), is_gcrf=self.is_gcrf)
        return b_nt


def field_along(
    orbit: Orbit, field: FieldModel, t_utc: Times, *, is_gcrf: bool, r_itrf_km: Floats | None = None, uses: int = 1
) -> FieldAlong | None:
    """Return the field along the orbit for the times ``t_utc``; None where it is better asked for at each of them.

    That is where they are few or sparse, and where the field or the orbit cannot be had at all places and nodes: the
    samples themselves then tell whether that is an error. ``r_itrf_km``: the orbit's positions, shape (n, 3), where
    they are known; the nearest and the farthest one must then have a field. ``uses``: how often it will be asked for
    about each time; what is asked for more than once has polynomials in the intervals beside as well.
    """
    stamps_ns = nanoseconds(t_utc)
    if len(stamps_ns) * uses < MIN_SAMPLES:
        return None
    try:
        if r_itrf_km is not None:
            radii_km = lengths(r_itrf_km)
            ends = [int(radii_km.argmin()), int(radii_km.argmax())]
            field.field_itrf_nt(t_utc[ends], r_itrf_km[ends])
        # Times that are there twice count once: a reading that was sent again changes no other's reference.
        once_ns = stamps_ns if np.all(stamps_ns[1:] > stamps_ns[:-1]) else np.unique(stamps_ns)
        pieces = _pieces(_Grid.of(orbit, field, uses), orbit, field, once_ns, is_gcrf=is_gcrf)
    except (ModelRangeError, IndexRangeError, PropagationError, OrbitFormatError):
        return None
    if pieces is None or pieces.gap_fraction > _MOST_ROUGH:
        return None
    return FieldAlong(orbit, field, is_gcrf, pieces)


@dataclass(frozen=True, slots=True)
class _Grid:
    """Where the nodes along an orbit lie, and how many samples each must stand for."""

    epoch_ns: int
    step_ns: int
    samples_per_node: float
    margin: int

    @classmethod
    def of(cls, orbit: Orbit, field: FieldModel, uses: int) -> _Grid:
        epoch_ns = int(orbit.epoch_utc.astype("datetime64[ns]").astype(np.int64))
        # Harmonics of degree 60 pass the satellite sixty times a turn: the nodes stand closer together.
        turn_rad = _TURN_RAD * min(1.0, MAX_DEGREE / highest_degree(field))
        return cls(epoch_ns, _interval_ns(orbit, turn_rad), SAMPLES_PER_NODE / uses, int(uses > 1))

    def polynomials(self, stamps_ns: Nanoseconds, values: Callable[[Nanoseconds], Floats]) -> Polynomials | None:
        """Return the polynomials of a field for the times ``stamps_ns``, from its values at nodes."""
        return polynomials(
            stamps_ns,
            self.epoch_ns,
            self.step_ns,
            values,
            samples_per_node=self.samples_per_node,
            tolerance=TOLERANCE_NT,
            margin=self.margin,
        )


def _pieces(
    grid: _Grid, orbit: Orbit, field: FieldModel, stamps_ns: Nanoseconds, *, is_gcrf: bool
) -> Polynomials | Stretches | None:
    """Return the polynomials of the field: where an index drives it, they end at the middles of hours.

    There the index has a corner. The polynomials before it follow the index as if it went straight on.
    """
    if not isinstance(field, SummedField) or field.external is None or field.external.index is None:
        return grid.polynomials(stamps_ns, partial(_field_at_nodes, orbit, field, is_gcrf))
    around = _CORNERS_AROUND * grid.step_ns
    corners_ns = field.corners_ns(int(stamps_ns[0]) - around, int(stamps_ns[-1]) + around)
    needed_ns = times_needed(stamps_ns, grid.epoch_ns, grid.step_ns, margin=grid.margin)
    if needed_ns is None:
        return None
    places_km = _places_at_nodes(orbit, needed_ns)
    which = np.searchsorted(corners_ns, stamps_ns, side="right")
    firsts = np.searchsorted(which, np.arange(len(corners_ns) + 2))
    between: list[Polynomials | None] = []
    for first, last in pairwise(firsts):
        part_ns = stamps_ns[first:last]
        straight = field.straight_at(int(part_ns[0])) if len(part_ns) else field
        values = partial(_field_at_places, straight, is_gcrf, needed_ns, places_km)
        between.append(grid.polynomials(part_ns, values) if len(part_ns) else None)
    return Stretches(corners_ns, tuple(between))


def highest_degree(field: FieldModel) -> int:
    """Return the highest degree of the harmonics that a model sums; 13 where it does not say."""
    if isinstance(field, SummedField):
        return max(highest_degree(field.main), 1 if field.crust is None else field.crust.max_degree)
    return field.max_degree if isinstance(field, (Igrf, FileField)) else MAX_DEGREE


def _places_at_nodes(orbit: Orbit, nodes_ns: Nanoseconds) -> Floats:
    """Return the positions at nodes, shape (n, 3), ITRF, km; NaN at those that an ephemeris does not cover."""
    nodes = nodes_ns.view("datetime64[ns]")
    if not isinstance(orbit, BoundedOrbit):
        return orbit.position_itrf_km(nodes)
    r_km, covered = np.full((len(nodes), 3), np.nan), orbit.covers(nodes)
    r_km[covered] = orbit.position_itrf_km(nodes[covered])
    return r_km


def _field_at_places(
    field: FieldModel, is_gcrf: bool, known_ns: Nanoseconds, places_km: Floats, nodes_ns: Nanoseconds
) -> Floats:
    """Return the field at nodes whose places are among those that are known; NaN where there is no place."""
    r_km = places_km[np.searchsorted(known_ns, nodes_ns)]
    b_nt, covered = np.full((len(nodes_ns), 3), np.nan), np.isfinite(r_km[:, 0])
    nodes = nodes_ns.view("datetime64[ns]")
    b_nt[covered] = field_at(field, nodes[covered], r_km[covered], is_gcrf=is_gcrf)
    return b_nt


def _field_at_nodes(orbit: Orbit, field: FieldModel, is_gcrf: bool, nodes_ns: Nanoseconds) -> Floats:
    """Return the field at nodes, shape (n, 3), nT; NaN at those that an ephemeris does not cover."""
    nodes = nodes_ns.view("datetime64[ns]")
    if not isinstance(orbit, BoundedOrbit):
        return field_at(field, nodes, orbit.position_itrf_km(nodes), is_gcrf=is_gcrf)
    b_nt, covered = np.full((len(nodes), 3), np.nan), orbit.covers(nodes)
    b_nt[covered] = field_at(field, nodes[covered], orbit.position_itrf_km(nodes[covered]), is_gcrf=is_gcrf)
    return b_nt


def field_at(field: FieldModel, t_utc: Times, r_itrf_km: Floats, *, is_gcrf: bool) -> Floats:
    """Return the field of the model at ``t_utc`` and ``r_itrf_km``, shape (n, 3), nT, in GCRF or else in ITRF.

    Raises
    ------
    ModelRangeError
        A time or a place is outside the model's validity.
    """
    b_itrf_nt = field.field_itrf_nt(t_utc, r_itrf_km)
    return itrf_to_gcrf_fast(t_utc, b_itrf_nt) if is_gcrf else b_itrf_nt


def positions_km(orbit: Orbit, t_utc: Times) -> Floats:
    """Return the ITRF positions at ``t_utc``, shape (n, 3), km: a time that is there twice changes no other's.

    Orbits choose by the number of times whether to interpolate, so that each time is asked for once.
    """
    if np.all(t_utc[1:] > t_utc[:-1]):
        return orbit.position_itrf_km(t_utc)
    times, of_sample = np.unique(t_utc, return_inverse=True)
    return orbit.position_itrf_km(times)[of_sample]


def _interval_ns(orbit: Orbit, turn_rad: float) -> int:
    """Return the distance of the nodes, nanoseconds, ``turn_rad`` at the perigee.

    From the ellipse of the second that follows the epoch.
    """
    start = orbit.epoch_utc.astype("datetime64[ns]")
    before_km, after_km = orbit.position_itrf_km(start + np.array([0, 1_000_000_000], "timedelta64[ns]"))
    r_km = 0.5 * (before_km + after_km)
    v_km_s = after_km - before_km + np.cross([0.0, 0.0, EARTH_ROTATION_RAD_S], r_km)
    ellipse = elements_from_state(r_km, v_km_s)
    a_km, e = ellipse.semi_major_axis_km, ellipse.eccentricity
    return interval_ns(a_km * (1.0 - e), a_km * (1.0 + e), turn_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Samples in order whose positions one orbit gives; None: the telemetry."""

    orbit: Orbit | None
    rows: Rows

    @classmethod
    def of(cls, orbit: Orbit | None, rows: NDArray[np.intp]) -> Part:
        """Return the part of these rows, as a slice where they follow each other: that copies nothing."""
        is_run = len(rows) > 0 and int(rows[-1]) - int(rows[0]) == len(rows) - 1
        return cls(orbit, slice(int(rows[0]), int(rows[-1]) + 1) if is_run else rows)

    def positions_km(self, t_utc: Times) -> Floats:
        """Return the orbit's positions at ``t_utc``, shape (n, 3), ITRF, km."""
        if self.orbit is None:
            raise OrbitMissingError("the telemetry has no positions at other times than its own")
        return positions_km(self.orbit, t_utc)

    def chunks(self, size: int) -> Iterator[Rows]:
        """Yield the rows, ``size`` at a time."""
        if not isinstance(self.rows, slice):
            for start in range(0, len(self.rows), size):
                yield self.rows[start : start + size]
            return
        for start in range(self.rows.start, self.rows.stop, size):
            yield slice(start, min(start + size, self.rows.stop))


def field_of_parts(
    t_utc: Times,
    parts: Sequence[Part],
    field: FieldModel,
    *,
    is_gcrf: bool,
    r_itrf_km: Floats | None = None,
    known: FieldAlong | None = None,
) -> Iterator[tuple[Rows, Floats]]:
    """Yield rows of the ``parts`` and the field there, shape (rows, 3), nT, in GCRF or else in ITRF.

    Interpolated along an orbit where its samples are dense, by what is ``known`` or else computed; elsewhere at
    ``r_itrf_km``, shape (n, 3), or, where that is not given, at the orbit's position.
    """
    for part in parts:
        along = known
        if part.orbit is not None and known is None:
            places_km = None if r_itrf_km is None else r_itrf_km[part.rows]
            along = field_along(part.orbit, field, t_utc[part.rows], is_gcrf=is_gcrf, r_itrf_km=places_km)
        for rows in part.chunks(_ROWS_INTERPOLATED if along else _ROWS):
            if along:
                yield rows, along.at(t_utc[rows])
            else:
                place_km = part.positions_km(t_utc[rows]) if r_itrf_km is None else r_itrf_km[rows]
                yield rows, field_at(field, t_utc[rows], place_km, is_gcrf=is_gcrf)
