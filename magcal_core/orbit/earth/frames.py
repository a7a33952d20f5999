"""GCRF, ITRF, TEME and the J2000 of FK5: positions, states and the matrices between them.

Notes
-----
TEME to ITRF is ``W R3(GMST82(UT1))`` with ``W = pom00(xp, yp, 0)`` (SGP4); GCRF to ITRF is the IAU 2006/2000A
reduction with the TIO locator (IERS2010); TEME and GCRF meet in ITRF; J2000 is ``pnm80(TT)^T R3(-eqeq94) r_TEME``,
which only the DEKART paper uses; EME2000 is GCRF less the frame bias of IAU 2006, as ephemerides of today have it.
Velocities are inertial, along the axes of the frame as they stand, and Earth-fixed in ITRF.
"""

from __future__ import annotations

from typing import Final, Literal, get_args

import erfa
import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.errors import FrameError
from magcal_core.orbit.earth.eop import earth_orientation
from magcal_core.orbit.earth.timescales import julian_tt

State = tuple[Floats, Floats]
Frame = Literal["GCRF", "ITRF", "TEME", "J2000", "EME2000"]

FRAMES: Final[tuple[Frame, ...]] = get_args(Frame)
ERA_RATE_RAD_S: Final = 7.292115146706979e-5
"""Rate of the Earth rotation angle per second of UT1, rad/s (IERS2010, eq. 5.15)."""

_NODES_PER_DAY: Final = 4
_STENCIL: Final = 6


def rotation_z(angle_rad: Floats) -> Floats:
    """Return R3(angle), shape (n, 3, 3): turns the axes by ``angle_rad``, shape (n,), about z."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    matrix = np.zeros((*np.shape(angle_rad), 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = cos
    matrix[..., 0, 1] = sin
    matrix[..., 1, 0] = -sin
    matrix[..., 2, 2] = 1.0
    return matrix


def polar_motion_matrix(t_utc: Times, tio_locator_rad: Floats | float = 0.0) -> Floats:
    """Return W, shape (n, 3, 3): from axes on the celestial intermediate pole to ITRF."""
    xp_rad, yp_rad = earth_orientation().polar_motion_rad(t_utc)
    return np.asarray(erfa.pom00(xp_rad, yp_rad, tio_locator_rad), np.float64)


def cip_coordinates(t_utc: Times) -> tuple[Floats, Floats, Floats]:
    """Return X, Y of the celestial intermediate pole and the locator s at ``t_utc``, each of shape (n,), rad.

    Notes
    -----
    IAU 2006/2000A (IERS2010) on nodes of a quarter of a day, Lagrange polynomials of degree 5 between: within
    1e-12 rad, 0.01 mm in a low orbit, of the full series at every instant.
    """
    day, fraction = julian_tt(t_utc)
    place = (day - erfa.DJ00 + fraction) * _NODES_PER_DAY
    first = np.floor(place).astype(np.int64) - (_STENCIL // 2 - 1)
    nodes = np.unique(first[:, None] + np.arange(_STENCIL))
    at_nodes = np.stack(erfa.xys06a(erfa.DJ00, nodes / _NODES_PER_DAY))
    weights = _lagrange_weights(place - first)
    column = np.searchsorted(nodes, first)
    x_rad, y_rad, s_rad = (
        np.sum(weights * series[column[:, None] + np.arange(_STENCIL)], axis=1) for series in at_nodes
    )
    return x_rad, y_rad, s_rad


def _lagrange_weights(place: Floats) -> Floats:
    """Return the weights of the nodes 0, 1, ... `_STENCIL` - 1 at ``place``, shape (n, _STENCIL)."""
    nodes = np.arange(_STENCIL)
    weights = np.ones((len(place), _STENCIL))
    for j in nodes:
        for k in nodes[nodes != j]:
            weights[:, j] *= (place - k) / (j - k)
    return weights


def gcrf_to_itrf_matrix(t_utc: Times) -> Floats:
    """Return the rotation from GCRF to ITRF at ``t_utc``, shape (n, 3, 3)."""
    celestial = erfa.c2ixys(*cip_coordinates(t_utc))
    era_rad = erfa.era00(*earth_orientation().julian_ut1(t_utc))
    polar_motion = polar_motion_matrix(t_utc, erfa.sp00(*julian_tt(t_utc)))
    return np.asarray(erfa.c2tcio(celestial, era_rad, polar_motion), np.float64)


def teme_to_itrf_matrix(t_utc: Times) -> Floats:
    """Return the rotation from TEME to ITRF at ``t_utc``, shape (n, 3, 3)."""
    gmst_rad = erfa.gmst82(*earth_orientation().julian_ut1(t_utc))
    return polar_motion_matrix(t_utc) @ rotation_z(gmst_rad)


def teme_to_j2000_matrix(t_utc: Times) -> Floats:
    """Return the rotation from TEME to the J2000 of FK5 at ``t_utc``, shape (n, 3, 3)."""
    tt = julian_tt(t_utc)
    of_date = np.swapaxes(erfa.pnm80(*tt), -1, -2)
    return np.asarray(of_date @ rotation_z(-erfa.eqeq94(*tt)), np.float64)


def rotation_matrix(t_utc: Times, from_frame: Frame, to_frame: Frame) -> Floats:
    """Return the rotation between two frames at ``t_utc``, shape (n, 3, 3).

    Raises
    ------
    FrameError
        A frame is not one of `FRAMES`.
    """
    for frame in (from_frame, to_frame):
        if frame not in FRAMES:
            raise FrameError(f"unknown frame {frame!r}; known are {', '.join(FRAMES)}")
    return _to_itrf(t_utc, to_frame, inverse=True) @ _to_itrf(t_utc, from_frame)


def _to_itrf(t_utc: Times, frame: Frame, *, inverse: bool = False) -> Floats:
    match frame:
        case "ITRF":
            matrix = np.broadcast_to(np.eye(3), (np.size(t_utc), 3, 3))
        case "GCRF":
            matrix = gcrf_to_itrf_matrix(t_utc)
        case "EME2000":
            bias = erfa.bp06(erfa.DJ00, 0.0)[0]
            matrix = gcrf_to_itrf_matrix(t_utc) @ np.transpose(bias)
        case "TEME":
            matrix = teme_to_itrf_matrix(t_utc)
        case "J2000":
            matrix = teme_to_itrf_matrix(t_utc) @ np.swapaxes(teme_to_j2000_matrix(t_utc), -1, -2)
    return np.swapaxes(matrix, -1, -2) if inverse else matrix


def rotate(matrix: Floats, vectors: Floats) -> Floats:
    """Return ``matrix[i] @ vectors[i]`` for every i, shape (n, 3)."""
    return np.asarray(np.matvec(matrix, vectors), np.float64)


def earth_rotation_itrf_rad_s(t_utc: Times) -> Floats:
    """Return the angular velocity of the Earth at ``t_utc``, shape (n, 3), ITRF, rad/s, along the pole."""
    rate = ERA_RATE_RAD_S * earth_orientation().ut1_rate(t_utc)
    return np.asarray(polar_motion_matrix(t_utc)[..., :, 2] * rate[:, None], np.float64)


def convert_position(t_utc: Times, r_km: Floats, from_frame: Frame, to_frame: Frame) -> Floats:
    """Return positions (or any vectors), shape (n, 3), of ``from_frame`` in ``to_frame``, in the unit they came in."""
    return rotate(rotation_matrix(t_utc, from_frame, to_frame), r_km)


def convert_state(t_utc: Times, r_km: Floats, v_km_s: Floats, from_frame: Frame, to_frame: Frame) -> State:
    """Return position, km, and velocity, km/s, each of shape (n, 3), of ``from_frame`` in ``to_frame``."""
    matrix = rotation_matrix(t_utc, from_frame, to_frame)
    if (from_frame == "ITRF") == (to_frame == "ITRF"):
        return rotate(matrix, r_km), rotate(matrix, v_km_s)
    omega_rad_s = earth_rotation_itrf_rad_s(t_utc)
    if to_frame == "ITRF":
        r_itrf_km = rotate(matrix, r_km)
        return r_itrf_km, rotate(matrix, v_km_s) - np.cross(omega_rad_s, r_itrf_km)
    return rotate(matrix, r_km), rotate(matrix, v_km_s + np.cross(omega_rad_s, r_km))


def teme_to_itrf(t_utc: Times, r_teme_km: Floats) -> Floats:
    """Return positions in ITRF, shape (n, 3), km, from TEME, shape (n, 3), km, at ``t_utc``, shape (n,)."""
    return convert_position(t_utc, r_teme_km, "TEME", "ITRF")


def teme_to_gcrf(t_utc: Times, r_teme_km: Floats) -> Floats:
    """Return positions in GCRF, shape (n, 3), km, from TEME, shape (n, 3), km, at ``t_utc``, shape (n,)."""
    return convert_position(t_utc, r_teme_km, "TEME", "GCRF")


def teme_to_j2000(t_utc: Times, r_teme_km: Floats) -> Floats:
    """Return positions in the J2000 of FK5, shape (n, 3), km, from TEME, shape (n, 3), km, at ``t_utc``, shape (n,)."""
    return rotate(teme_to_j2000_matrix(t_utc), r_teme_km)


def gcrf_to_itrf(t_utc: Times, r_gcrf_km: Floats) -> Floats:
    """Return positions in ITRF, shape (n, 3), km, from GCRF, shape (n, 3), km, at ``t_utc``, shape (n,)."""
    return convert_position(t_utc, r_gcrf_km, "GCRF", "ITRF")


def itrf_to_gcrf(t_utc: Times, r_itrf_km: Floats) -> Floats:
    """Return positions in GCRF, shape (n, 3), km, from ITRF, shape (n, 3), km, at ``t_utc``, shape (n,)."""
    return convert_position(t_utc, r_itrf_km, "ITRF", "GCRF")
