"""Sun and Moon seen from the geocentre: JPL's DE421, or the analytical series of SOFA where it is not installed."""

from __future__ import annotations

import importlib
import importlib.util
from functools import cache
from typing import Final, Literal, Protocol, get_args

import erfa
import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.errors import ModelRangeError, OptionError
from magcal_core.orbit.earth.timescales import julian_tt

EphemerisName = Literal["de421", "erfa"]

EPHEMERIDES: Final[tuple[EphemerisName, ...]] = get_args(EphemerisName)


class _JplEphemeris(Protocol):
    """What is used of `jplephem.Ephemeris`: geocentric and barycentric vectors, km and km/day, at a TDB Julian date."""

    earth_share: float
    jalpha: float
    jomega: float

    def position_and_velocity(self, name: str, tdb: Floats, tdb2: Floats) -> tuple[Floats, Floats]: ...


def default_ephemeris() -> EphemerisName:
    """Return ``de421`` where its package is installed, else ``erfa``; an orbit says which one it used."""
    return "de421" if importlib.util.find_spec("de421") else "erfa"


@cache
def _de421() -> _JplEphemeris:
    ephemeris: _JplEphemeris = importlib.import_module("jplephem").Ephemeris(importlib.import_module("de421"))
    return ephemeris


def _from_de421(t_utc: Times) -> tuple[Floats, Floats]:
    ephemeris = _de421()
    day, fraction = julian_tt(t_utc)
    if day.size and not (ephemeris.jalpha < day.min() and day.max() + 1.0 < ephemeris.jomega):
        raise ModelRangeError(f"DE421 has Julian dates {ephemeris.jalpha:.1f} to {ephemeris.jomega:.1f}")
    fraction = fraction + erfa.dtdb(day, fraction, 0.0, 0.0, 0.0, 0.0) / 86400.0
    parts = {name: ephemeris.position_and_velocity(name, day, fraction) for name in ("sun", "earthmoon", "moon")}
    vectors = []
    for k in (0, 1):
        moon = parts["moon"][k]
        earth = parts["earthmoon"][k] - moon * ephemeris.earth_share
        vectors.append(np.stack([(parts["sun"][k] - earth).T, moon.T], axis=1))
    return vectors[0], vectors[1] / 86400.0


def _from_erfa(t_utc: Times) -> tuple[Floats, Floats]:
    day, fraction = julian_tt(t_utc)
    heliocentric, _ = erfa.epv00(day, fraction)
    states = (heliocentric, erfa.moon98(day, fraction))
    km_per_au = erfa.DAU / 1e3
    sun_km, sun_km_s = -states[0]["p"] * km_per_au, -states[0]["v"] * km_per_au / 86400.0
    moon_km, moon_km_s = states[1]["p"] * km_per_au, states[1]["v"] * km_per_au / 86400.0
    return np.stack([sun_km, moon_km], axis=1), np.stack([sun_km_s, moon_km_s], axis=1)


def sun_moon_gcrf(t_utc: Times, ephemeris: EphemerisName = "de421") -> tuple[Floats, Floats]:
    """Return geometric positions, km, and velocities, km/s, of Sun and Moon, each of shape (n, 2, 3), GCRF, geocentric.

    Raises
    ------
    ModelRangeError
        DE421 does not reach the date (1900 to 2200 as packaged).
    OptionError
        The ephemeris is not one of `EPHEMERIDES`.

    Notes
    -----
    ``de421``: Chebyshev series of JPL at TDB (DE421). ``erfa``: `epv00` and `moon98` of SOFA, 0.5 km and 4 km from
    DE421, which moves a low orbit by 1 mm in a day. Geometric, not apparent: aberration has no place in a force.
    """
    if ephemeris not in EPHEMERIDES:
        raise OptionError(f"unknown ephemeris {ephemeris!r}; known are {', '.join(EPHEMERIDES)}")
    return _from_de421(t_utc) if ephemeris == "de421" else _from_erfa(t_utc)
