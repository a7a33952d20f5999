"""The direct dipole: the field of a moment along the Earth's axis, as attitude studies take it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.constants import EARTH_RADIUS_MAGNETIC_KM
from magcal_core.errors import ModelRangeError
from magcal_core.field.igrf import MIN_RADIUS_KM
from magcal_core.orbit.earth.timescales import nanoseconds


@dataclass(frozen=True, slots=True)
class DirectDipole:
    """A dipole at the Earth's centre with its moment along -z, constant in time (ROM).

    Attributes
    ----------
    equatorial_field_nt : float
        Field at the equator of the sphere of 6371.2 km, nT.
    """

    equatorial_field_nt: float = 30036.0
    name: str = field(default="dipole", init=False)

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``r_itrf_km``, shape (n, 3): shape (n, 3), ITRF, nT; any time, any radius from 6350 km.

        Raises
        ------
        ModelRangeError
            A radius is less than 6350 km or not finite.

        Notes
        -----
        B = B0 (a/r)^3 (3 (m.u) u - m) with u = r / |r| and m = -z.
        """
        places = np.atleast_2d(np.asarray(r_itrf_km, np.float64))
        if places.shape != (len(nanoseconds(t_utc)), 3):
            raise ModelRangeError(f"positions have shape {places.shape}; want ({np.size(t_utc)}, 3)")
        radius_km = np.linalg.norm(places, axis=1)
        is_good = (radius_km >= MIN_RADIUS_KM) & np.isfinite(radius_km)
        if not is_good.all():
            first = int(np.flatnonzero(~is_good)[0])
            raise ModelRangeError(
                f"{self.name} at radius {radius_km[first]:.1f} km (sample {first}): "
                f"it is used from {MIN_RADIUS_KM:.0f} km"
            )
        upward = places / radius_km[:, None]
        field_nt = -3.0 * upward[:, 2:3] * upward
        field_nt[:, 2] += 1.0
        strength_nt = self.equatorial_field_nt * (EARTH_RADIUS_MAGNETIC_KM / radius_km) ** 3
        return np.asarray(field_nt * strength_nt[:, None], np.float64)
