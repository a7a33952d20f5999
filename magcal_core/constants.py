"""Physical constants, each with its source."""

from typing import Final

EARTH_GM_KM3_S2: Final = 398600.4415
"""Geocentric gravitational constant of EGM96, km3/s2."""
EARTH_RADIUS_EGM96_KM: Final = 6378.1363
"""Reference radius of EGM96, km."""
EGM96_MAX_DEGREE: Final = 36
"""Highest degree of the EGM96 table that is shipped."""
EARTH_RADIUS_MAGNETIC_KM: Final = 6371.2
"""Reference radius of the IGRF, km."""
EARTH_ROTATION_RAD_S: Final = 7.292115e-5
"""Mean rotation rate of the Earth, rad/s (IERS Conventions)."""
SUN_GM_KM3_S2: Final = 1.32712440041279419e11
"""Gravitational constant of the Sun, km3/s2 (DE440)."""
MOON_GM_KM3_S2: Final = 4902.800118
"""Gravitational constant of the Moon, km3/s2 (DE440)."""
