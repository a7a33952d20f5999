"""Where a simulated satellite is, what field and light there are, at any instants since its start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.field import FieldModel
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth import frames
from magcal_core.orbit.earth.bodies import sun_moon_gcrf

EARTH_KM: Final = 6390.0
"""Radius of the Earth with the air that takes the Sun's light, km."""
SUN_RADIUS_KM: Final = 695_700.0


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """The way of a satellite along an orbit from ``start_utc`` on; ``t_s`` is seconds since then, shape (n,)."""

    orbit: Orbit
    field: FieldModel
    start_utc: np.datetime64

    def t_utc(self, t_s: Floats) -> Times:
        """Return the instants, shape (n,), UTC, to a nanosecond."""
        t_utc: Times = self.start_utc.astype("datetime64[ns]") + np.rint(t_s * 1e9).astype("timedelta64[ns]")
        return t_utc

    def state_gcrf(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Return position, km, and velocity, km/s, each of shape (n, 3), GCRF."""
        return self.orbit.state_gcrf(self.t_utc(t_s))

    def field_gcrf_nt(self, t_s: Floats) -> Floats:
        """Return the true field, shape (n, 3), GCRF, nT."""
        t_utc = self.t_utc(t_s)
        b_itrf_nt = self.field.field_itrf_nt(t_utc, self.orbit.position_itrf_km(t_utc))
        return frames.itrf_to_gcrf(t_utc, b_itrf_nt)

    def sun_gcrf_km(self, t_s: Floats) -> Floats:
        """Return the Sun's place, shape (n, 3), GCRF, km; it moves 1e-5 rad a minute."""
        return sun_moon_gcrf(self.t_utc(t_s))[0][:, 0]

    def light(self, t_s: Floats) -> Floats:
        """Return the share of the Sun's disc that the satellite sees, shape (n,): 0 in the umbra.

        Notes
        -----
        Of the disc what the Earth's edge leaves, taken as a straight line that crosses it: 1 where the angle between
        Sun and Earth's centre exceeds the sum of both radii, 0 where it is less than their difference.
        """
        r_km, to_sun_km = self.state_gcrf(t_s)[0], self.sun_gcrf_km(t_s)
        to_sun_km = to_sun_km - r_km
        radius, away = np.linalg.norm(r_km, axis=1), np.linalg.norm(to_sun_km, axis=1)
        earth_rad, sun_rad = np.arcsin(np.minimum(EARTH_KM / radius, 1.0)), np.arcsin(SUN_RADIUS_KM / away)
        cosine = -np.einsum("ni,ni->n", r_km, to_sun_km) / (radius * away)
        between_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
        return np.asarray(np.clip((between_rad - earth_rad + sun_rad) / (2.0 * sun_rad), 0.0, 1.0))
