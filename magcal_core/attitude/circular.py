"""The circular orbit of the attitude simulation: its axes, and the field along it in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import erfa
import numpy as np

from magcal_core.arrays import Floats
from magcal_core.constants import EARTH_GM_KM3_S2, EARTH_RADIUS_EGM96_KM, EARTH_ROTATION_RAD_S
from magcal_core.errors import InputError
from magcal_core.field import FieldModel

EPOCH_UTC: Final = np.datetime64("2020-01-01T00:00:00", "ns")
"""Start of a simulation where none is given."""
_JD_1970: Final = 2440587.5


@dataclass(frozen=True, slots=True)
class CircularOrbit:
    """A circular orbit in the inertial frame, Z to the north.

    Attributes
    ----------
    altitude_km : float
        Above 6378.1363 km.
    inclination_rad, u0_rad, raan_rad : float
        Inclination, argument of latitude at the epoch, right ascension of the ascending node, rad.
    epoch_utc : datetime64
        Time of the start.
    greenwich_rad : float, optional
        Where Greenwich is at the start, rad from the X axis; without it as the Earth stands at the epoch.

    Raises
    ------
    InputError
        The altitude is not within 100 to 100,000 km, the inclination not within 0 to 180 deg.
    """

    altitude_km: float = 500.0
    inclination_rad: float = np.deg2rad(62.0)
    u0_rad: float = 0.0
    raan_rad: float = 0.0
    epoch_utc: np.datetime64 = EPOCH_UTC
    greenwich_rad: float | None = None

    def __post_init__(self) -> None:
        if not 100.0 <= self.altitude_km <= 1e5:
            raise InputError(f"altitude is {self.altitude_km} km; want 100 to 100000 km")
        if not 0.0 <= self.inclination_rad <= np.pi:
            raise InputError(f"inclination is {np.rad2deg(self.inclination_rad)} deg; want 0 to 180 deg")
        if not (np.isfinite(self.u0_rad) and np.isfinite(self.raan_rad)) or np.isnat(self.epoch_utc):
            raise InputError("argument of latitude, node and epoch of the orbit must be finite")

    @property
    def radius_km(self) -> float:
        """Geocentric radius, km."""
        return EARTH_RADIUS_EGM96_KM + self.altitude_km

    @property
    def rate_rad_s(self) -> float:
        """Orbital rate n, rad/s."""
        return float(np.sqrt(EARTH_GM_KM3_S2 / self.radius_km**3))

    @property
    def period_s(self) -> float:
        """Period, s."""
        return 2.0 * np.pi / self.rate_rad_s

    def rot_osk_isk(self, t_s: Floats) -> Floats:
        """Return the matrices from inertial to orbital components, shape (n, 3, 3), at ``t_s`` after the epoch.

        Notes
        -----
        X along the motion, Y up along the radius, Z against the orbit normal (`docs/references.md`: ROM).
        """
        u = self.u0_rad + self.rate_rad_s * t_s
        cu, su = np.cos(u), np.sin(u)
        co, so = np.cos(self.raan_rad), np.sin(self.raan_rad)
        ci, si = np.cos(self.inclination_rad), np.sin(self.inclination_rad)
        along = np.stack([-co * su - so * cu * ci, -so * su + co * cu * ci, cu * si], axis=-1)
        up = np.stack([co * cu - so * su * ci, so * cu + co * su * ci, su * si], axis=-1)
        down_normal = np.broadcast_to([-so * si, co * si, -ci], up.shape)
        rot: Floats = np.stack([along, up, down_normal], axis=-2)
        return rot

    def field_osk_nt(self, model: FieldModel, t_s: Floats) -> Floats:
        """Return the field of ``model`` along the orbit, shape (n, 3), orbital axes, nT, at ``t_s`` after the epoch.

        Raises
        ------
        ModelRangeError
            A time or the altitude is outside the model's validity.
        """
        rot_osk_isk = self.rot_osk_isk(t_s)
        angle = self._earth_angle_rad() + EARTH_ROTATION_RAD_S * t_s
        rot_itrf_isk = np.zeros_like(rot_osk_isk)
        rot_itrf_isk[:, 0, 0] = rot_itrf_isk[:, 1, 1] = np.cos(angle)
        rot_itrf_isk[:, 0, 1] = np.sin(angle)
        rot_itrf_isk[:, 1, 0] = -rot_itrf_isk[:, 0, 1]
        rot_itrf_isk[:, 2, 2] = 1.0
        r_itrf_km = self.radius_km * np.einsum("nij,nj->ni", rot_itrf_isk, rot_osk_isk[:, 1])
        t_utc = self.epoch_utc.astype("datetime64[ns]") + (t_s * 1e9).astype("timedelta64[ns]")
        b_itrf_nt = model.field_itrf_nt(t_utc, r_itrf_km)
        b_osk_nt: Floats = np.einsum("nij,nkj,nk->ni", rot_osk_isk, rot_itrf_isk, b_itrf_nt, optimize=True)
        return b_osk_nt

    def _earth_angle_rad(self) -> float:
        """Return the angle of Greenwich at the start, rad; by the epoch to 0.004 deg, as UTC stands for UT1."""
        if self.greenwich_rad is not None:
            return self.greenwich_rad
        since_1970_days = (self.epoch_utc - np.datetime64("1970-01-01", "ns")) / np.timedelta64(1, "D")
        return float(erfa.era00(_JD_1970, since_1970_days))
