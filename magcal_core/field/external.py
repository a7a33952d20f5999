"""The field of the ring current and of what it induces in the Earth: one dipole that an hourly index drives [CHAOS]_.

Notes
-----
    B_ext(t, r) = (G e - U) n + G i (a/r)^3 (n - 3 (n.u) u),    u = r/|r|, a = 6371.2 km,

n the unit vector to the northern geomagnetic pole, from IGRF-14 at the sample, e and i the external and the induced
part of the index, nT. That is -grad V of V = -a [(G e - U)(r/a) + G i (a/r)^2] cos(theta_d), theta_d counted from n,
which is z of SM coordinates. U stands for the constant currents of magnetotail and magnetopause.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.constants import EARTH_RADIUS_MAGNETIC_KM
from magcal_core.errors import IndexRangeError, ModelRangeError
from magcal_core.field.external_kernel import add_external
from magcal_core.field.hourly import CELL_NS, HourlyIndex
from magcal_core.field.parts import sum_of_parts
from magcal_core.field.shc import igrf_coefficients

GAIN: Final = 0.94
"""G: what of the index is left on the way from the observatories to the orbit."""
UNIFORM_NT: Final = 10.6
"""U, nT."""
MEAN_EXTERNAL_NT: Final = -13.3
"""Mean of the external part of RC over 2015 to 2026, nT."""
MAX_RADIUS_KM: Final = 2.0 * EARTH_RADIUS_MAGNETIC_KM
"""Beyond two Earth radii more than 6 nT of |B| would remain."""
_NO_CELLS: Final = np.full((1, 4), np.nan)
_DAY_NS: Final = 48 * CELL_NS
_SAMPLES_PER_THREAD: Final = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class ExternalField:
    """The external field by an hourly index, or by its mean.

    Attributes
    ----------
    kind : str
        A key of `EXTERNAL_KINDS`.
    index : HourlyIndex, optional
        None with ``mean``.
    gap : str
        One of `INDEX_GAPS`.
    start_ns, step_ns, cells : int, int, shape (m, 4)
        The index as lines in cells of time (`HourlyIndex.cells`).
    """

    kind: str
    index: HourlyIndex | None
    gap: str
    start_ns: int
    step_ns: int
    cells: Floats

    @classmethod
    def by_index(cls, kind: str, index: HourlyIndex, gap: str = "refuse") -> ExternalField:
        """Return the field by an hourly index."""
        return cls(kind, index, gap, index.start_ns, CELL_NS, index.cells)

    @classmethod
    def by_mean(cls) -> ExternalField:
        """Return the mean field, which is the same at all times."""
        return cls("mean", None, "mean", 0, _DAY_NS, _NO_CELLS)

    def add_to(self, field_nt: Floats, stamps_ns: Nanoseconds, r_itrf_km: Floats) -> None:
        """Add the field at ``stamps_ns``, (n,), and ``r_itrf_km``, shape (n, 3), to ``field_nt``, (n, 3), ITRF, nT.

        Raises
        ------
        IndexRangeError
            The index has no value at a time, and its mean may not stand for it.
        ModelRangeError
            A place is beyond two Earth radii.
        """
        square = np.einsum("ij,ij->i", r_itrf_km, r_itrf_km)
        if np.any(is_far := ~(square <= MAX_RADIUS_KM**2)):
            row = int(np.flatnonzero(is_far)[0])
            raise ModelRangeError(
                f"external field at radius {np.sqrt(square[row]):.1f} km (sample {row}): "
                f"it is used to {MAX_RADIUS_KM:.0f} km"
            )
        knots_ns, dipole_nt = geomagnetic_dipole()
        if len(stamps_ns) and not (knots_ns[0] <= stamps_ns.min() and stamps_ns.max() <= knots_ns[-1]):
            raise ModelRangeError("external field: the geomagnetic pole is that of IGRF-14, known from 1900 to 2030")
        mean = (MEAN_EXTERNAL_NT if self.gap == "mean" else np.nan, 0.0)
        constants = (GAIN, UNIFORM_NT, EARTH_RADIUS_MAGNETIC_KM)

        def part(rows: slice) -> int:
            index = (self.start_ns, self.step_ns, self.cells)
            unknown: int = add_external(
                stamps_ns[rows], r_itrf_km[rows], knots_ns, dipole_nt, *index, mean, constants, field_nt[rows]
            )
            return unknown

        if sum_of_parts(len(stamps_ns), part, _SAMPLES_PER_THREAD) and self.index is not None:
            raise self._range_error(self.index, stamps_ns)

    def is_known(self, stamps_ns: Nanoseconds) -> NDArray[np.bool_]:
        """Return at which of ``stamps_ns`` the index, and not its mean, gives the field, shape (n,)."""
        if self.index is None:
            return np.zeros(len(stamps_ns), np.bool_)
        return self.index.hours(stamps_ns) >= 0

    def corners_ns(self, first_ns: int, last_ns: int) -> Nanoseconds:
        """Return the times from ``first_ns`` to ``last_ns`` at which the index turns or begins or ends."""
        if self.index is None:
            return np.zeros(0, np.int64)
        low, high = ((stamp - self.start_ns) // self.step_ns for stamp in (first_ns, last_ns))
        cells = np.arange(max(low, 0), min(high, len(self.cells)) + 1)
        is_middle = cells % 2 == 1
        is_end = self._has_value(cells) != self._has_value(cells - 1)
        return np.asarray(self.start_ns + cells[is_middle | is_end] * self.step_ns, np.int64)

    def _has_value(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        inside = (cells >= 0) & (cells < len(self.cells))
        return np.asarray(inside & ~np.isnan(self.cells[np.where(inside, cells, 0), 0]))

    def straight_at(self, stamp_ns: int) -> ExternalField:
        """Return the field with the line that the index follows at ``stamp_ns`` drawn out for a day to both sides."""
        cell = (stamp_ns - self.start_ns) // self.step_ns
        line = np.full(4, np.nan) if self.gap == "refuse" else np.array([MEAN_EXTERNAL_NT, 0.0, 0.0, 0.0])
        if self._has_value(np.array([cell]))[0]:
            line = self.cells[cell].copy()
        start_ns = self.start_ns + cell * self.step_ns - _DAY_NS
        line[0::2] -= line[1::2] * _DAY_NS
        return ExternalField(self.kind, self.index, self.gap, start_ns, 2 * _DAY_NS + self.step_ns, line[None])

    def _range_error(self, index: HourlyIndex, stamps_ns: Nanoseconds) -> IndexRangeError:
        unknown = stamps_ns[~self.is_known(stamps_ns)]
        when = np.datetime_as_string(np.datetime64(int(unknown[0]), "ns"), unit="s")
        return IndexRangeError(
            f"the index {index.name} has no value for {len(unknown)} of {len(stamps_ns)} samples, "
            f"the first at {when}Z: it is there from {index.span}; index_gap mean takes its mean"
        )


@lru_cache(maxsize=1)
def geomagnetic_dipole() -> tuple[Nanoseconds, Floats]:
    """Return the knots of IGRF-14, nanoseconds since 1970, and -(g11, h11, g10) at them, shape (k, 3), nT."""
    gauss = igrf_coefficients(14)
    dipole_nt = -np.stack([gauss.g_nt[:, 1, 1], gauss.h_nt[:, 1, 1], gauss.g_nt[:, 1, 0]], axis=1)
    return gauss.knots_ns, np.ascontiguousarray(dipole_nt)


def geomagnetic_axis(stamps_ns: Nanoseconds) -> Floats:
    """Return the unit vector to the northern geomagnetic pole at ``stamps_ns``, shape (n, 3), ITRF."""
    knots_ns, dipole_nt = geomagnetic_dipole()
    at = np.clip(np.searchsorted(knots_ns, stamps_ns, side="right") - 1, 0, len(knots_ns) - 2)
    part = (stamps_ns - knots_ns[at]) / (knots_ns[at + 1] - knots_ns[at])
    axis = dipole_nt[at] + part[:, None] * (dipole_nt[at + 1] - dipole_nt[at])
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


def shapes(stamps_ns: Nanoseconds, r_itrf_km: Floats) -> tuple[Floats, Floats]:
    """Return n and (a/r)^3 (n - 3 (n.u) u), each of shape (n, 3), ITRF: the uniform and the induced field for 1 nT."""
    axis = geomagnetic_axis(stamps_ns)
    radius_km = np.linalg.norm(r_itrf_km, axis=1, keepdims=True)
    up = r_itrf_km / radius_km
    along = np.einsum("ij,ij->i", axis, up)[:, None]
    return axis, (EARTH_RADIUS_MAGNETIC_KM / radius_km) ** 3 * (axis - 3.0 * along * up)
