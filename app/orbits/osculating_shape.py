"""How an orbit that is kept lies in space: what a simulation on a circular orbit takes from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.orbits.parsing import orbit_of
from magcal_core.constants import EARTH_RADIUS_EGM96_KM
from magcal_core.orbit.messages.elements import elements_from_state


@dataclass(frozen=True, slots=True)
class OrbitShape:
    """Mean altitude above 6378.1363 km, km, and inclination, deg: those of the osculating orbit at the epoch."""

    altitude_km: float
    inclination_deg: float


def shape_of(content: str) -> OrbitShape:
    """Return the shape of the orbit that is kept as ``content``.

    Raises
    ------
    PropagationError
        There is no state at the epoch.
    """
    orbit = orbit_of(content)
    r_gcrf_km, v_gcrf_km_s = orbit.state_gcrf(np.array([orbit.epoch_utc], "datetime64[ns]"))
    elements = elements_from_state(r_gcrf_km[0], v_gcrf_km_s[0])
    altitude_km = elements.semi_major_axis_km - EARTH_RADIUS_EGM96_KM
    return OrbitShape(altitude_km, float(np.rad2deg(elements.inclination_rad)))
