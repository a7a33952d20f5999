"""An orbit integrated from a state: gravity to degree 36, Sun and Moon, solid tide and drag on request."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from magcal_core.arrays import Floats, Times
from magcal_core.constants import EARTH_RADIUS_EGM96_KM, EGM96_MAX_DEGREE
from magcal_core.errors import OptionError, OrbitFormatError, PropagationError
from magcal_core.orbit.earth.bodies import EphemerisName, default_ephemeris
from magcal_core.orbit.earth.frames import Frame, convert_state
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.orbit.propagators import dop853
from magcal_core.orbit.propagators.forces import (
    LOVE_NUMBER_K2,
    NODE_S,
    ExponentialDrag,
    ForceTables,
    RotationName,
    drag_accelerations,
    force_model,
    force_tables,
    gcrf_to_itrf_matrices,
)
from magcal_core.orbit.propagators.gravity import GravityField, egm96

DEFAULT_RTOL: Final = 1e-12
"""Relative tolerance of a step; 24 h of a low orbit end within 1 mm of a tighter integration."""
ATOL_KM: Final = 1e-9
ATOL_KM_S: Final = 1e-12
MAX_SPAN_DAYS: Final = 366.0
"""Longest time from the epoch; beyond it the drag that nobody knows has long won."""

_FIRST_STEP_S: Final = 10.0
_MAX_STEPS: Final = 4_000_000
_LARGEST_RADIUS_KM: Final = 400_000.0
_WHY: Final = {
    dop853.STEP_TOO_SMALL: "the step shrank below 1 us",
    dop853.BELOW_SURFACE: "the orbit meets the Earth's surface",
    dop853.TOO_MANY_STEPS: f"more than {_MAX_STEPS} steps",
}


class NumericalOrbit:
    """An orbit integrated forward and backward from one state; satisfies `magcal_core.orbit.Orbit`.

    Parameters
    ----------
    epoch_utc : datetime64
        Epoch of the state, UTC.
    r_gcrf_km, v_gcrf_km_s : shape (3,)
        Position, km, and velocity, km/s, GCRF.
    degree : int
        Degree and order of EGM96, 0 to 36.
    third_bodies : bool
        Whether Sun and Moon attract the satellite.
    tide : bool
        Whether the solid tide (k2 = 0.30) acts.
    drag : ExponentialDrag, optional
        Atmosphere and ballistic coefficient.
    rtol : float
        Relative tolerance of a step.
    ephemeris : str, optional
        ``de421`` or ``erfa``; by default DE421 where it is installed.
    rotation : str
        ``iers``, or ``uniform`` for the ideal Earth of energy studies.
    field : GravityField, optional
        Another gravity field in place of EGM96; then ``degree`` cuts it.

    Raises
    ------
    OrbitFormatError
        The state is not finite, or not that of a satellite of the Earth.
    ModelRangeError
        The degree is outside the gravity field.
    OptionError
        Another option has a value that it cannot have.

    Notes
    -----
    DOP853 with dense output; the steps do not depend on what is asked, so the same time gives the same bits in whatever
    order it is asked for. Forces as in `magcal_core.orbit.propagators.forces`.
    """

    def __init__(
        self,
        epoch_utc: np.datetime64,
        r_gcrf_km: ArrayLike,
        v_gcrf_km_s: ArrayLike,
        degree: int = 12,
        third_bodies: bool = True,
        *,
        tide: bool = False,
        drag: ExponentialDrag | None = None,
        rtol: float = DEFAULT_RTOL,
        ephemeris: EphemerisName | None = None,
        rotation: RotationName = "iers",
        field: GravityField | None = None,
    ) -> None:
        if not 0 < rtol < 1e-3:
            raise OptionError(f"rtol is {rtol}; want more than 0 and less than 1e-3")
        self._epoch_ns = int(nanoseconds(np.array([epoch_utc], "datetime64[ns]"))[0])
        self.state_km_km_s: Final = _checked_state(r_gcrf_km, v_gcrf_km_s)
        self.field: Final = (field or egm96(EGM96_MAX_DEGREE)).truncated(degree)
        self.has_third_bodies: Final = third_bodies
        self.has_tide: Final = tide
        self.drag: Final = drag
        self.rtol: Final = rtol
        self.ephemeris: Final = ephemeris or default_ephemeris()
        self.rotation: Final = rotation
        self._model: Final = force_model(self.field, third_bodies, LOVE_NUMBER_K2 if tide else 0.0, drag)
        self._steps: dict[float, dop853.Steps] = {}
        self._tables: ForceTables | None = None

    @property
    def model(self) -> str:
        """What computes the position."""
        return "numerical"

    @property
    def epoch_utc(self) -> np.datetime64:
        """Epoch of the state, UTC."""
        return np.datetime64(self._epoch_ns, "ns")

    @property
    def degree(self) -> int:
        """Degree and order of the gravity field."""
        return self.field.degree

    @classmethod
    def from_state(
        cls,
        epoch_utc: np.datetime64,
        r_km: ArrayLike,
        v_km_s: ArrayLike,
        frame: Frame = "GCRF",
        *,
        degree: int = 12,
        third_bodies: bool = True,
        tide: bool = False,
        drag: ExponentialDrag | None = None,
        rtol: float = DEFAULT_RTOL,
        rotation: RotationName = "iers",
    ) -> NumericalOrbit:
        """Return the orbit through a state given in GCRF, ITRF, TEME or J2000 (FK5).

        Raises
        ------
        FrameError
            The frame is none of these.
        OrbitFormatError
            The state is not that of a satellite.
        """
        state = _checked_state(r_km, v_km_s, is_inertial=frame != "ITRF")
        r_gcrf_km, v_gcrf_km_s = state[None, :3], state[None, 3:]
        if frame != "GCRF":
            t_utc = np.array([epoch_utc], "datetime64[ns]")
            r_gcrf_km, v_gcrf_km_s = convert_state(t_utc, r_gcrf_km, v_gcrf_km_s, frame, "GCRF")
        return cls(
            epoch_utc,
            r_gcrf_km[0],
            v_gcrf_km_s[0],
            degree,
            third_bodies,
            tide=tide,
            drag=drag,
            rtol=rtol,
            rotation=rotation,
        )

    def state_gcrf(self, t_utc: Times) -> tuple[Floats, Floats]:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), GCRF.

        Raises
        ------
        PropagationError
            The orbit cannot be integrated to a time.
        ModelRangeError
            Earth orientation or the ephemeris is not known there.
        """
        states = self._states(self._since_epoch_s(t_utc))
        return states[:, :3].copy(), states[:, 3:].copy()

    def position_itrf_km(self, t_utc: Times) -> Floats:
        """Return the position at ``t_utc``, shape (n, 3), ITRF, km."""
        t_s = self._since_epoch_s(t_utc)
        states = self._states(t_s)
        if not t_s.size:
            return states[:, :3]
        matrices = gcrf_to_itrf_matrices(t_s, self.tables(float(t_s.min()), float(t_s.max())))
        return np.asarray(np.matvec(matrices, states[:, :3]))

    def tables(self, from_s: float, until_s: float) -> ForceTables:
        """Return Earth rotation, Sun and Moon as the forces use them from ``from_s`` to ``until_s`` or longer.

        Seconds since the epoch; tables are kept and grow with what is asked.
        """
        known = self._tables
        if known is not None:
            if known.from_s <= from_s and until_s <= known.until_s:
                return known
            from_s, until_s = min(from_s, known.from_s), max(until_s, known.until_s)
        self._tables = force_tables(self.epoch_utc, from_s, until_s, self.ephemeris, self.rotation)
        return self._tables

    def drag_acceleration_km_s2(self, t_utc: Times) -> Floats:
        """Return the acceleration by drag along the orbit at ``t_utc``, shape (n, 3), GCRF, km/s2; 0 without drag."""
        t_s = self._since_epoch_s(t_utc)
        states = self._states(t_s)
        if self.drag is None or not t_s.size:
            return np.zeros((len(t_s), 3))
        tables = self.tables(float(t_s.min()), float(t_s.max()))
        return np.asarray(drag_accelerations(t_s, states, tables, self._model))

    def _since_epoch_s(self, t_utc: Times) -> Floats:
        t_s = (nanoseconds(t_utc) - self._epoch_ns) / 1e9
        far_days = np.abs(t_s).max(initial=0.0) / 86400.0
        if far_days > MAX_SPAN_DAYS:
            raise PropagationError(
                f"numerical orbit of {self.epoch_utc}: {far_days:.0f} d from its epoch; limit {MAX_SPAN_DAYS:.0f} d"
            )
        return np.asarray(t_s)

    def _states(self, t_s: Floats) -> Floats:
        out = np.empty((len(t_s), 6))
        for direction, chosen in ((1.0, t_s >= 0.0), (-1.0, t_s < 0.0)):
            if np.any(chosen):
                steps = self._steps_until(direction, float(np.abs(t_s[chosen]).max()))
                out[chosen] = dop853.evaluate(t_s[chosen], steps.t_s, steps.y, steps.polynomial)
        return out

    def _steps_until(self, direction: float, far_s: float) -> dop853.Steps:
        known = self._steps.get(direction)
        if known is None:
            start = np.array([0.0]), self.state_km_km_s[None, :].copy(), np.empty((0, 7, 6))
            known = dop853.Steps(*start, direction * _FIRST_STEP_S, dop853.DONE)
        if len(known.polynomial) and abs(known.t_s[-1]) >= far_s:
            return known
        known = self._longer(known, direction * max(far_s, 1e-9))
        self._steps[direction] = known
        return known

    def _longer(self, known: dop853.Steps, until_s: float) -> dop853.Steps:
        ends = known.t_s[-1], until_s
        tables = self.tables(min(ends) - NODE_S, max(ends) + NODE_S)
        n, t_s, y, polynomial, next_s, status = dop853.integrate(
            known.t_s[-1],
            known.y[-1],
            known.next_step_s,
            until_s,
            self.rtol,
            ATOL_KM,
            ATOL_KM_S,
            _MAX_STEPS,
            tables,
            self._model,
        )
        if status != dop853.DONE:
            at = self.epoch_utc + np.timedelta64(round(t_s[n] * 1e9), "ns")
            raise PropagationError(f"numerical orbit of {self.epoch_utc}: stopped at {at}: {_WHY[status]}")
        return dop853.Steps(
            np.concatenate([known.t_s, t_s[1 : n + 1]]),
            np.concatenate([known.y, y[1 : n + 1]]),
            np.concatenate([known.polynomial, polynomial[:n]]),
            next_s,
            status,
        )


def _checked_state(r_km: ArrayLike, v_km_s: ArrayLike, *, is_inertial: bool = True) -> Floats:
    r, v = np.asarray(r_km, np.float64), np.asarray(v_km_s, np.float64)
    if r.shape != (3,) or v.shape != (3,):
        raise OrbitFormatError(f"a state has a position and a velocity of 3 numbers each, not {r.shape} and {v.shape}")
    state = np.concatenate([r, v])
    if not np.all(np.isfinite(state)):
        raise OrbitFormatError("the state has a number that is not finite")
    radius_km, speed_km_s = float(np.linalg.norm(r)), float(np.linalg.norm(v))
    if not EARTH_RADIUS_EGM96_KM < radius_km < _LARGEST_RADIUS_KM:
        raise OrbitFormatError(
            f"the position is {radius_km:.1f} km from the geocentre; want {EARTH_RADIUS_EGM96_KM} to "
            f"{_LARGEST_RADIUS_KM:.0f} km"
        )
    if is_inertial and not 0.0 < speed_km_s < 12.0:
        raise OrbitFormatError(f"the speed is {speed_km_s:.3f} km/s; want more than 0 and less than 12 km/s")
    state.setflags(write=False)
    return state
