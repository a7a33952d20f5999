"""Osculating elements of a state, and the state of osculating elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from magcal_core.arrays import Floats
from magcal_core.constants import EARTH_GM_KM3_S2
from magcal_core.errors import OrbitFormatError

_SINGULAR = 1e-11


@dataclass(frozen=True, slots=True)
class OsculatingElements:
    """Elements of the ellipse that touches the orbit, in the frame of the state they come from; angles in rad.

    A circle has its perigee at the node, an orbit in the equator its node on the x axis.
    """

    semi_major_axis_km: float
    eccentricity: float
    inclination_rad: float
    raan_rad: float
    argument_of_perigee_rad: float
    true_anomaly_rad: float

    @property
    def argument_of_latitude_rad(self) -> float:
        """Argument of perigee plus true anomaly, rad, from -pi to pi."""
        return _wrapped(self.argument_of_perigee_rad + self.true_anomaly_rad)

    @property
    def eccentric_anomaly_rad(self) -> float:
        """Eccentric anomaly, rad, from -pi to pi."""
        half = np.sqrt((1.0 - self.eccentricity) / (1.0 + self.eccentricity)) * np.tan(self.true_anomaly_rad / 2.0)
        return float(2.0 * np.arctan(half))

    @property
    def mean_anomaly_rad(self) -> float:
        """Mean anomaly, rad, from -pi to pi."""
        eccentric = self.eccentric_anomaly_rad
        return float(eccentric - self.eccentricity * np.sin(eccentric))

    def period_s(self, gm_km3_s2: float = EARTH_GM_KM3_S2) -> float:
        """Return the period of the ellipse, s."""
        return float(2.0 * np.pi * np.sqrt(self.semi_major_axis_km**3 / gm_km3_s2))


def elements_from_state(r_km: ArrayLike, v_km_s: ArrayLike, gm_km3_s2: float = EARTH_GM_KM3_S2) -> OsculatingElements:
    """Return the osculating elements of one state, each part of shape (3,), km and km/s, in an inertial frame.

    Raises
    ------
    OrbitFormatError
        The state is not finite, or not that of an ellipse.
    """
    r, v = np.asarray(r_km, np.float64), np.asarray(v_km_s, np.float64)
    momentum = np.cross(r, v)
    size, distance = np.linalg.norm(momentum), np.linalg.norm(r)
    energy = 0.5 * (v @ v) - gm_km3_s2 / distance if distance else np.nan
    if not (size > 0.0 and energy < 0.0):
        raise OrbitFormatError("the state is not that of a closed orbit: it escapes, falls straight, or is not finite")
    pole = momentum / size
    eccentricity = np.cross(v, momentum) / gm_km3_s2 - r / distance
    e = float(np.linalg.norm(eccentricity))
    in_plane = float(np.hypot(pole[0], pole[1]))
    node = np.array([-pole[1], pole[0], 0.0]) / in_plane if in_plane > _SINGULAR else np.array([1.0, 0.0, 0.0])
    perigee = eccentricity / e if e > _SINGULAR else node
    return OsculatingElements(
        semi_major_axis_km=float(-gm_km3_s2 / (2.0 * energy)),
        eccentricity=e if e > _SINGULAR else 0.0,
        inclination_rad=float(np.arctan2(in_plane, pole[2])),
        raan_rad=float(np.arctan2(node[1], node[0])),
        argument_of_perigee_rad=_angle(node, perigee, pole),
        true_anomaly_rad=_angle(perigee, r, pole),
    )


def state_from_elements(elements: OsculatingElements, gm_km3_s2: float = EARTH_GM_KM3_S2) -> tuple[Floats, Floats]:
    """Return position, km, and velocity, km/s, each of shape (3,), in the frame of the elements.

    Raises
    ------
    OrbitFormatError
        The elements are not those of an ellipse.
    """
    a, e = elements.semi_major_axis_km, elements.eccentricity
    if not (a > 0.0 and 0.0 <= e < 1.0):
        raise OrbitFormatError(f"semi-major axis {a} km, eccentricity {e}: want a > 0 and 0 <= e < 1")
    nu, i, node, perigee = (
        elements.true_anomaly_rad,
        elements.inclination_rad,
        elements.raan_rad,
        elements.argument_of_perigee_rad,
    )
    parameter = a * (1.0 - e * e)
    radius = parameter / (1.0 + e * np.cos(nu))
    speed = np.sqrt(gm_km3_s2 / parameter)
    cn, sn, ci, si, cw, sw = np.cos(node), np.sin(node), np.cos(i), np.sin(i), np.cos(perigee), np.sin(perigee)
    towards_perigee = np.array([cn * cw - sn * sw * ci, sn * cw + cn * sw * ci, sw * si])
    ahead = np.array([-cn * sw - sn * cw * ci, -sn * sw + cn * cw * ci, cw * si])
    r_km = radius * (np.cos(nu) * towards_perigee + np.sin(nu) * ahead)
    v_km_s = speed * (-np.sin(nu) * towards_perigee + (e + np.cos(nu)) * ahead)
    return r_km, v_km_s


def _angle(start: Floats, end: Floats, pole: Floats) -> float:
    """Return the angle from ``start`` to ``end`` about ``pole``, rad, from -pi to pi."""
    return float(np.arctan2(np.cross(start, end) @ pole, start @ end))


def _wrapped(angle_rad: float) -> float:
    return float(np.arctan2(np.sin(angle_rad), np.cos(angle_rad)))
