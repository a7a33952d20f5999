"""The field of a coefficient file, or some degrees of it, at the instant and place of every sample."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds, Times
from magcal_core.constants import EARTH_RADIUS_MAGNETIC_KM
from magcal_core.errors import ModelRangeError
from magcal_core.field.coefficients import CoefficientFile
from magcal_core.field.harmonics import ComponentSeries, series_of
from magcal_core.field.igrf import MAX_RADIUS_KM, MIN_RADIUS_KM, by_interval, radius_error
from magcal_core.field.kernel import sum_harmonics
from magcal_core.field.parts import sum_of_parts
from magcal_core.orbit.earth.timescales import nanoseconds

_CELL_NS: Final = 7_200_000_000_000
"""A spline is taken as a line within cells of two hours at most: 1e-6 nT for a change of the change of 100 nT/a^2."""
_CELLS_AT_ONCE: Final = 64


@dataclass(frozen=True)
class FileField:
    """The field of a file's degrees from ``min_degree`` to ``max_degree``.

    Attributes
    ----------
    file : CoefficientFile
    min_degree, max_degree : int
        Within those of the file.
    name : str
        In messages.
    """

    file: CoefficientFile
    min_degree: int
    max_degree: int
    name: str

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``t_utc``, shape (n,), and ``r_itrf_km``, shape (n, 3): shape (n, 3), ITRF, nT.

        Raises
        ------
        ModelRangeError
            A time is outside the file's validity, or a radius outside 6350 to 31856 km.
        """
        stamps = nanoseconds(t_utc)
        places = np.ascontiguousarray(np.atleast_2d(r_itrf_km), np.float64)
        if places.shape != (len(stamps), 3):
            raise ModelRangeError(f"positions have shape {places.shape}; want ({len(stamps)}, 3)")
        self._check_times(stamps)
        if self.file.order <= 2:
            return self._evaluate(
                stamps, places, self.file.breaks_ns, _lines(self.file, self.min_degree, self.max_degree)
            )
        field_nt = np.empty_like(places)
        for rows, knots_ns, series in self._cells(stamps):
            field_nt[rows] = self._evaluate(stamps[rows], places[rows], knots_ns, series)
        return field_nt

    def _evaluate(self, stamps: Nanoseconds, places: Floats, knots_ns: Nanoseconds, series: ComponentSeries) -> Floats:
        order = by_interval(stamps, knots_ns)
        if order is not None:
            sorted_nt, field_nt = self._evaluate(stamps[order], places[order], knots_ns, series), np.empty_like(places)
            field_nt[order] = sorted_nt
            return field_nt
        field_nt = np.empty_like(places)
        tables = (knots_ns, series.value_nt, series.slope_nt, series.recursion, (MIN_RADIUS_KM, MAX_RADIUS_KM))

        def part(rows: slice) -> int:
            outside: int = sum_harmonics(stamps[rows], places[rows], EARTH_RADIUS_MAGNETIC_KM, *tables, field_nt[rows])
            return outside

        if sum_of_parts(len(stamps), part, least=5000 if self.max_degree > 30 else 25_000):
            raise radius_error(self.name, places)
        return field_nt

    def _cells(self, stamps: Nanoseconds) -> Iterator[tuple[NDArray[np.intp], Nanoseconds, ComponentSeries]]:
        """Yield rows of the samples, and the lines of the cells of time that these are in.

        Where a cell begins and ends depends on the file alone, so that no sample depends on its neighbours.
        """
        breaks = self.file.breaks_ns
        per_piece = -(-np.diff(breaks) // _CELL_NS)
        first = np.concatenate([[0], np.cumsum(per_piece)])
        piece = np.clip(np.searchsorted(breaks, stamps, side="right") - 1, 0, len(breaks) - 2)
        cell = np.minimum((stamps - breaks[piece]) // _CELL_NS, per_piece[piece] - 1)
        number = first[piece] + cell
        used, row_of = np.unique(number, return_inverse=True)
        order = np.argsort(row_of, kind="stable")
        ends = np.searchsorted(row_of[order], np.arange(0, len(used) + _CELLS_AT_ONCE, _CELLS_AT_ONCE))
        for i, begin in enumerate(range(0, len(used), _CELLS_AT_ONCE)):
            numbers = used[begin : begin + _CELLS_AT_ONCE]
            yield order[ends[i] : ends[i + 1]], *self._series_of_cells(numbers, first)

    def _series_of_cells(self, numbers: Nanoseconds, first: Nanoseconds) -> tuple[Nanoseconds, ComponentSeries]:
        breaks, (powers, recursion) = self.file.breaks_ns, _powers(self.file, self.min_degree, self.max_degree)
        piece = np.searchsorted(first, numbers, side="right") - 1
        length = np.diff(breaks)[piece]
        ends_ns = [np.minimum((numbers - first[piece] + i) * _CELL_NS, length) + breaks[piece] for i in (0, 1)]
        at_ends = [_at(powers, piece, (end - breaks[piece]) / length) for end in ends_ns]
        # Between cells that are not neighbours lies one that no sample is in.
        knots, rows = [int(ends_ns[0][0])], []
        for i in range(len(numbers)):
            if ends_ns[0][i] != knots[-1]:
                rows.append(-1)
                knots.append(int(ends_ns[0][i]))
            rows.append(i)
            knots.append(int(ends_ns[1][i]))
        series = ComponentSeries(at_ends[0][rows], (at_ends[1] - at_ends[0])[rows], recursion)
        return np.array(knots, np.int64), series

    def _check_times(self, stamps: Nanoseconds) -> None:
        if not len(stamps) or self.file.is_always:
            return
        for stamp in (stamps.min(), stamps.max()):
            if not self.file.breaks_ns[0] <= stamp <= self.file.last_ns:
                when = np.datetime_as_string(np.datetime64(int(stamp), "ns"), unit="s")
                raise ModelRangeError(
                    f"{self.name} at {when}Z: the file is valid from {self.file.valid_from} to {self.file.valid_until}"
                )


def _at(powers: Floats, piece: NDArray[np.intp], share: Floats) -> Floats:
    """Return the series at ``share`` of the way through each ``piece``, shape (cells, L + 1, L + 1, 6)."""
    value = powers[piece, -1].copy()
    for power in range(powers.shape[1] - 2, -1, -1):
        value *= share[:, None, None, None]
        value += powers[piece, power]
    return np.asarray(value)


@lru_cache(maxsize=4)
def _powers(file: CoefficientFile, min_degree: int, max_degree: int) -> tuple[Floats, Floats]:
    """Return the series by piece and power of time, shape (p, order, L + 1, L + 1, 6), and the recursion."""
    flat = (-1, *file.g_nt.shape[2:])
    series, recursion = series_of(file.g_nt.reshape(flat), file.h_nt.reshape(flat), min_degree, max_degree)
    return series.reshape(*file.g_nt.shape[:2], *series.shape[1:]), recursion


@lru_cache(maxsize=4)
def _lines(file: CoefficientFile, min_degree: int, max_degree: int) -> ComponentSeries:
    """Return the series of a file whose coefficients are constants or lines."""
    powers, recursion = _powers(file, min_degree, max_degree)
    slope = powers[:, 1] if file.order == 2 else np.zeros_like(powers[:, 0])
    return ComponentSeries(np.ascontiguousarray(powers[:, 0]), np.ascontiguousarray(slope), recursion)
