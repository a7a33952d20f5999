"""Positions from mean elements by SGP4, with every output checked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from sgp4.api import SGP4_ERRORS, Satrec

from magcal_core.arrays import Floats, Times
from magcal_core.errors import PropagationError, TleFormatError
from magcal_core.orbit.earth.earth_fixed import teme_to_itrf_fast
from magcal_core.orbit.earth.frames import State, convert_state
from magcal_core.orbit.earth.timescales import julian_utc, nanoseconds
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.dense import interpolated, interval_ns

RADIUS_MARGIN_KM: Final = 50.0
"""How far outside perigee and apogee of the mean orbit a position may lie, km."""


class MeanElements(Protocol):
    """Mean elements of SGP4: a TLE or an OMM."""

    @property
    def norad_id(self) -> str:
        """Catalogue number."""
        ...

    @property
    def epoch_utc(self) -> np.datetime64:
        """Epoch, UTC."""
        ...

    @property
    def perigee_km(self) -> float:
        """Radius of the perigee of the mean orbit, km."""
        ...

    @property
    def apogee_km(self) -> float:
        """Radius of the apogee of the mean orbit, km."""
        ...

    def satrec(self) -> Satrec:
        """Return the elements as `sgp4` wants them."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Sgp4Orbit:
    """The orbit of one set of mean elements (SGP4, WGS-72).

    Raises
    ------
    PropagationError
        SGP4 refuses the elements.
    """

    elements: MeanElements
    model: str = field(default="sgp4", init=False)
    _satrec: Satrec = field(init=False, repr=False)

    def __post_init__(self) -> None:
        satrec = self.elements.satrec()
        object.__setattr__(self, "_satrec", satrec)
        if satrec.error:
            raise self._failure(satrec.error, self.elements.epoch_utc)

    @classmethod
    def from_tle(cls, text: str) -> Sgp4Orbit:
        """Return the orbit of the one TLE in ``text``, two- or three-line form.

        Raises
        ------
        TleFormatError, TleChecksumError
            The text is not one sound TLE.
        """
        tles = parse_tles(text)
        if len(tles) != 1:
            raise TleFormatError(f"the text has {len(tles)} TLEs; want one")
        return cls(tles[0])

    @property
    def epoch_utc(self) -> np.datetime64:
        """Epoch of the elements, UTC."""
        return self.elements.epoch_utc

    def state_teme(self, t_utc: Times) -> State:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), TEME.

        Raises
        ------
        PropagationError
            SGP4 reports an error, or a position is not finite or not between perigee and apogee with a margin.
        """
        codes, r_teme_km, v_teme_km_s = self._satrec.sgp4_array(*julian_utc(t_utc))
        if codes.any():
            first = int(np.flatnonzero(codes)[0])
            raise self._failure(int(codes[first]), t_utc[first])
        self._check_radius(t_utc, r_teme_km)
        return r_teme_km, v_teme_km_s

    def position_itrf_km(self, t_utc: Times) -> Floats:
        """Return the position at ``t_utc``, shape (n, 3), ITRF, km.

        Where the samples are dense it is interpolated between nodes (`orbit.propagators.dense`), within 1 cm.
        """
        stamps = nanoseconds(t_utc)
        step_ns = interval_ns(self.elements.perigee_km, self.elements.apogee_km)
        epoch_ns = int(self.epoch_utc.astype("datetime64[ns]").astype(np.int64))
        r_itrf_km = interpolated(stamps, epoch_ns, step_ns, self._each_position)
        return self._each_position(stamps) if r_itrf_km is None else r_itrf_km

    def _each_position(self, stamps_ns: NDArray[np.int64]) -> Floats:
        """Return the position, shape (n, 3), ITRF, km, propagated to every time."""
        t_utc = stamps_ns.view("datetime64[ns]")
        return teme_to_itrf_fast(t_utc, self.state_teme(t_utc)[0])

    def state_gcrf(self, t_utc: Times) -> State:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), GCRF."""
        return convert_state(t_utc, *self.state_teme(t_utc), "TEME", "GCRF")

    def state_itrf(self, t_utc: Times) -> State:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), ITRF."""
        return convert_state(t_utc, *self.state_teme(t_utc), "TEME", "ITRF")

    def _check_radius(self, t_utc: Times, r_teme_km: Floats) -> None:
        radius_km = np.sqrt(np.einsum("ij,ij->i", r_teme_km, r_teme_km))
        low_km, high_km = self.elements.perigee_km - RADIUS_MARGIN_KM, self.elements.apogee_km + RADIUS_MARGIN_KM
        is_good = (radius_km >= low_km) & (radius_km <= high_km)
        if not is_good.all():
            first = int(np.flatnonzero(~is_good)[0])
            why = f"radius {radius_km[first]:.1f} km is outside {low_km:.1f} to {high_km:.1f} km"
            raise PropagationError(f"SGP4 code 0, but the {why}: {self._place(t_utc[first])}")

    def _failure(self, code: int, t_utc: np.datetime64) -> PropagationError:
        return PropagationError(f"SGP4 code {code} ({SGP4_ERRORS.get(code, 'unknown')}): {self._place(t_utc)}")

    def _place(self, t_utc: np.datetime64) -> str:
        at, epoch = (f"{np.datetime_as_string(t, unit='ms')}Z" for t in (t_utc, self.epoch_utc))
        return f"object {self.elements.norad_id}, epoch {epoch}, at {at}"
