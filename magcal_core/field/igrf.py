"""The International Geomagnetic Reference Field, generations 13 and 14, at the instant and place of every sample."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.constants import EARTH_RADIUS_MAGNETIC_KM
from magcal_core.errors import ModelRangeError
from magcal_core.field.harmonics import ComponentSeries, component_series
from magcal_core.field.kernel import BLOCK, sum_harmonics
from magcal_core.field.shc import GaussCoefficients, igrf_coefficients
from magcal_core.orbit.earth.timescales import nanoseconds

MAX_DEGREE: Final = 13
MIN_RADIUS_KM: Final = 6350.0
"""Below 7 km under the poles the sources of the crust are no longer inside."""
MAX_RADIUS_KM: Final = 5.0 * EARTH_RADIUS_MAGNETIC_KM
"""Beyond 5 Earth radii the currents of the magnetosphere, which the IGRF leaves out, are no longer small."""

_SAMPLES_PER_THREAD: Final = 25_000


@dataclass(frozen=True, slots=True)
class Igrf:
    """The IGRF up to ``max_degree``, its coefficients linear in time between knots five years apart (IGRF14).

    Attributes
    ----------
    version : int
        Generation: 14 (1900.0 to 2030.0) or 13 (1900.0 to 2025.0).
    max_degree : int
        1 to 13.
    frozen_epoch : datetime64, optional
        Take the coefficients of this instant for all times, as the DEKART paper does with 2020-01-01.

    Raises
    ------
    ModelRangeError
        There is no such generation or degree, or the frozen epoch is outside its validity.
    """

    version: int = 14
    max_degree: int = MAX_DEGREE
    frozen_epoch: np.datetime64 | None = None
    name: str = field(init=False)

    def __post_init__(self) -> None:
        if not 1 <= self.max_degree <= MAX_DEGREE:
            raise ModelRangeError(f"max_degree is {self.max_degree}; want 1 to {MAX_DEGREE}")
        truncated = "" if self.max_degree == MAX_DEGREE else f"-{self.max_degree}x{self.max_degree}"
        frozen = "" if self.frozen_epoch is None else f"@{self.frozen_epoch.astype('datetime64[D]')}"
        object.__setattr__(self, "name", f"igrf-{self.version}{truncated}{frozen}")
        _tables(self.version, self.max_degree, self.frozen_epoch)

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``t_utc``, shape (n,), and ``r_itrf_km``, shape (n, 3): shape (n, 3), ITRF, nT.

        Raises
        ------
        ModelRangeError
            A time is outside the validity, or a radius outside 6350 to 31856 km.
        """
        gauss, series = _tables(self.version, self.max_degree, self.frozen_epoch)
        stamps = nanoseconds(t_utc)
        places = np.ascontiguousarray(np.atleast_2d(r_itrf_km), np.float64)
        if places.shape != (len(stamps), 3):
            raise ModelRangeError(f"positions have shape {places.shape}; want ({len(stamps)}, 3)")
        self._check_times(stamps, gauss)
        order = _by_interval(stamps, gauss.knots_ns)
        if order is None:
            return self._evaluate(stamps, places, gauss, series)
        field_nt = np.empty_like(places)
        field_nt[order] = self._evaluate(stamps[order], places[order], gauss, series)
        return field_nt

    def _evaluate(
        self, stamps: NDArray[np.int64], places: Floats, gauss: GaussCoefficients, series: ComponentSeries
    ) -> Floats:
        field_nt = np.empty_like(places)
        tables = (gauss.knots_ns, series.value_nt, series.slope_nt, series.recursion, (MIN_RADIUS_KM, MAX_RADIUS_KM))

        def part(rows: slice) -> int:
            outside: int = sum_harmonics(stamps[rows], places[rows], EARTH_RADIUS_MAGNETIC_KM, *tables, field_nt[rows])
            return outside

        n = len(stamps)
        workers = max(1, min(len(os.sched_getaffinity(0)), n // _SAMPLES_PER_THREAD))
        edges = np.linspace(0, n, workers + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(edges)]
        if workers == 1:
            outside = part(parts[0])
        else:
            with ThreadPoolExecutor(workers) as pool:
                outside = sum(pool.map(part, parts))
        if outside:
            raise _radius_error(self.name, places)
        return field_nt

    def _check_times(self, stamps: NDArray[np.int64], gauss: GaussCoefficients) -> None:
        if not len(stamps):
            return
        for stamp in (stamps.min(), stamps.max()):
            if not gauss.knots_ns[0] <= stamp <= gauss.knots_ns[-1]:
                when = np.datetime_as_string(np.datetime64(int(stamp), "ns"), unit="s")
                raise ModelRangeError(f"{self.name} at {when}Z: it is valid from {gauss.first} to {gauss.last}")


@lru_cache(maxsize=32)
def _tables(
    version: int, max_degree: int, frozen_epoch: np.datetime64 | None
) -> tuple[GaussCoefficients, ComponentSeries]:
    gauss = igrf_coefficients(version)
    if frozen_epoch is not None:
        gauss = gauss.at(frozen_epoch)
    return gauss, component_series(gauss, max_degree)


def _by_interval(stamps: NDArray[np.int64], knots_ns: NDArray[np.int64]) -> NDArray[np.intp] | None:
    """Return an order in which intervals between knots do not alternate, or None where they hardly do."""
    if len(stamps) <= BLOCK:
        return None
    first, last = np.searchsorted(knots_ns, [stamps.min(), stamps.max()], side="right")
    if first == last:
        return None
    interval = np.searchsorted(knots_ns, stamps, side="right")
    if np.count_nonzero(np.diff(interval)) * BLOCK <= len(stamps):
        return None
    return np.argsort(interval, kind="stable")


def _radius_error(name: str, places: Floats) -> ModelRangeError:
    radius_km = np.linalg.norm(places, axis=1)
    is_good = (radius_km >= MIN_RADIUS_KM) & (radius_km <= MAX_RADIUS_KM)
    first = int(np.flatnonzero(~is_good)[0])
    return ModelRangeError(
        f"{name} at radius {radius_km[first]:.1f} km (sample {first}): it is used from "
        f"{MIN_RADIUS_KM:.0f} to {MAX_RADIUS_KM:.0f} km"
    )
