"""The terms of the energy balance along an orbit, each as a series in m2/s2."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.integrate import cumulative_simpson

from magcal_core.arrays import Floats
from magcal_core.constants import EARTH_RADIUS_EGM96_KM, EARTH_ROTATION_RAD_S, MOON_GM_KM3_S2, SUN_GM_KM3_S2
from magcal_core.orbit.propagators.forces import (
    LOVE_NUMBER_K2,
    NODE_S,
    ForceTables,
    cip_axis_gcrf,
    gcrf_to_itrf_matrices,
    sun_moon_positions_km,
)
from magcal_core.orbit.propagators.gravity import GravityField, normal_field

Series = Mapping[str, Floats]

M2_PER_KM2: Final = 1e6
BODIES: Final[Mapping[str, float]] = MappingProxyType({"sun": SUN_GM_KM3_S2, "moon": MOON_GM_KM3_S2})
"""Body -> GM, km3/s2, in the order of the tables."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """States along an orbit with the frames and bodies of each.

    Attributes
    ----------
    t_s : shape (n,)
        Seconds since the epoch of ``tables``.
    r_km, v_km_s : shape (n, 3)
        GCRF.
    a_km_s2 : shape (n, 3)
        Non-gravitational acceleration, GCRF, km/s2.
    tables : ForceTables
        Earth rotation, Sun and Moon.
    field : GravityField
        The Earth's potential.
    """

    t_s: Floats
    r_km: Floats
    v_km_s: Floats
    a_km_s2: Floats
    tables: ForceTables
    field: GravityField
    has_third_bodies: bool
    has_tide: bool

    def every(self, step: int) -> Track:
        """Return the track with every ``step``-th state alone."""
        rows = slice(None, None, step)
        return replace(
            self, t_s=self.t_s[rows], r_km=self.r_km[rows], v_km_s=self.v_km_s[rows], a_km_s2=self.a_km_s2[rows]
        )

    @property
    def r_itrf_km(self) -> Floats:
        """Positions, shape (n, 3), ITRF, km."""
        return np.asarray(np.matvec(gcrf_to_itrf_matrices(self.t_s, self.tables), self.r_km))

    @property
    def rotation_rad_s(self) -> Floats:
        """The Earth's rotation vector along the celestial intermediate pole, shape (n, 3), GCRF, rad/s."""
        return EARTH_ROTATION_RAD_S * cip_axis_gcrf(self.t_s, self.tables)

    @property
    def v_earth_km_s(self) -> Floats:
        """Velocity relative to the turning Earth, v - w x r, shape (n, 3), GCRF axes, km/s."""
        return self.v_km_s - np.cross(self.rotation_rad_s, self.r_km)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.vecdot(a, b), np.float64)


def work_m2_s2(t_s: Floats, power_km2_s3: Floats) -> Floats:
    """Return the running integral of a power by Simpson's rule, shape (n,), m2/s2, from ``power_km2_s3``, shape (n,).

    Notes
    -----
    Simpson on every three samples, their own spacing allowed (ENERGY, eq. 19).
    """
    return np.asarray(cumulative_simpson(power_km2_s3, x=t_s, initial=0.0) * M2_PER_KM2)


def kinetic_m2_s2(track: Track) -> Floats:
    """Return v^2/2, shape (n,), m2/s2."""
    return 0.5 * _dot(track.v_km_s, track.v_km_s) * M2_PER_KM2


def rotation_m2_s2(track: Track) -> Floats:
    """Return -w.(r x v) with w along the celestial intermediate pole, shape (n,), m2/s2."""
    return -_dot(track.rotation_rad_s, np.cross(track.r_km, track.v_km_s)) * M2_PER_KM2


def third_body_m2_s2(r_km: Floats, d_km: Floats, gm_km3_s2: float) -> Floats:
    """Return the potential of a third body at ``d_km`` felt at ``r_km``, each of shape (n, 3): shape (n,), m2/s2.

    Notes
    -----
    GM [1/|d - r| - r.d/d^3 - 1/d], written so that the leading terms cancel in algebra and not in rounding:
    with p = r.d/d^2, q = r^2/d^2 - 2p, s = sqrt(1 + q) it is GM/d [-q/(s (1 + s)) - p] (ENERGY).
    """
    d2 = _dot(d_km, d_km)
    p = _dot(r_km, d_km) / d2
    q = _dot(r_km, r_km) / d2 - 2.0 * p
    s = np.sqrt(1.0 + q)
    return np.asarray(gm_km3_s2 / np.sqrt(d2) * (-q / (s * (1.0 + s)) - p) * M2_PER_KM2)


def third_body_gradient_km_s2(r_km: Floats, d_km: Floats, gm_km3_s2: float) -> Floats:
    """Return the gradient of `third_body_m2_s2`, shape (n, 3), GCRF, km/s2."""
    apart = d_km - r_km
    near = np.linalg.norm(apart, axis=1, keepdims=True)
    far = np.linalg.norm(d_km, axis=1, keepdims=True)
    return np.asarray(gm_km3_s2 * (apart / near**3 - d_km / far**3))


def _tide_geometry(r_km: Floats, d_km: Floats, gm_km3_s2: float) -> tuple[Floats, Floats, Floats]:
    r, d = np.linalg.norm(r_km, axis=1), np.linalg.norm(d_km, axis=1)
    scale = 0.5 * LOVE_NUMBER_K2 * gm_km3_s2 / d**3 * EARTH_RADIUS_EGM96_KM**5
    return r, _dot(r_km, d_km) / (r * d), scale


def solid_tide_m2_s2(r_km: Floats, d_km: Floats, gm_km3_s2: float) -> Floats:
    """Return the potential of the solid tide that a body raises, shape (n,), m2/s2.

    Notes
    -----
    (k2/2) GM_d/d^3 a_e^5/r^3 (3 cos^2 Theta - 1) (ENERGY).
    """
    r, cosine, scale = _tide_geometry(r_km, d_km, gm_km3_s2)
    return np.asarray(scale / r**3 * (3.0 * cosine**2 - 1.0) * M2_PER_KM2)


def solid_tide_gradient_km_s2(r_km: Floats, d_km: Floats, gm_km3_s2: float) -> Floats:
    """Return the gradient of `solid_tide_m2_s2`, shape (n, 3), GCRF, km/s2."""
    r, cosine, scale = _tide_geometry(r_km, d_km, gm_km3_s2)
    towards = d_km / np.linalg.norm(d_km, axis=1, keepdims=True)
    inner = (3.0 - 15.0 * cosine**2)[:, None] * r_km / r[:, None] + 6.0 * cosine[:, None] * towards
    return np.asarray((scale / r**4)[:, None] * inner)


def printed_tide(r_km: Floats, d_km: Floats, gm_km3_s2: float) -> Floats:
    """Return what the paper prints as a tidal potential, shape (n,): an acceleration in m/s2 without its directions.

    Notes
    -----
    (k2/2) GM_d/r_d^3 a_e^5/r^4 (3 - 15 cos^2 Theta + 6 cos Theta), ENERGY (17), (18).
    """
    r, cosine, scale = _tide_geometry(r_km, d_km, gm_km3_s2)
    return np.asarray(scale / r**4 * (3.0 - 15.0 * cosine**2 + 6.0 * cosine) * 1e3)


def full_rotation_rad_s(t_s: Floats, tables: ForceTables) -> Floats:
    """Return the whole angular velocity of ITRF, shape (n, 3), GCRF, rad/s: rotation, its rate, the pole's motions.

    Notes
    -----
    From M = W R3(ERA) C and its time derivative between two nodes: M^T dM/dt = -[w x].
    """
    node = np.floor(t_s / NODE_S)
    i, x = node.astype(np.int64) - tables.first_node, (t_s / NODE_S - node)[:, None, None]
    d_polar, d_cio = ((m[i + 1] - m[i]) / NODE_S for m in (tables.polar, tables.cio))
    cio = tables.cio[i] + NODE_S * x * d_cio
    rate_rad_s = (tables.era_rad[i + 1] - tables.era_rad[i]) / NODE_S
    era_rad = tables.era_rad[i] + rate_rad_s * NODE_S * x[:, 0, 0]
    turn = np.zeros((len(t_s), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(era_rad)
    turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = np.sin(era_rad), -np.sin(era_rad), 1.0
    spin = turn @ cio
    polar = tables.polar[i] + NODE_S * x * d_polar
    small = np.swapaxes(polar @ spin, 1, 2) @ (d_polar @ spin + polar @ (turn @ d_cio))
    slow_rad_s = (
        np.stack([small[:, 1, 2] - small[:, 2, 1], small[:, 2, 0] - small[:, 0, 2], small[:, 0, 1] - small[:, 1, 0]], 1)
        / 2
    )
    return np.asarray(rate_rad_s[:, None] * cio[:, 2, :] + slow_rad_s)


def frame_rate_m2_s2(track: Track) -> Floats:
    """Return what the change of the Earth's rotation vector adds to the balance, shape (n,), m2/s2.

    Notes
    -----
    In a frame that turns with w(t), v^2/2 - w.(r x v) - U + int dw.(r x v) is conserved. The constant rate about the
    pole leaves out precession, nutation, polar motion and the length of day; this is the difference, 0.07 m2/s2 a day.
    """
    momentum = np.cross(track.r_km, track.v_km_s)
    whole = full_rotation_rad_s(track.t_s, track.tables)
    steps = _dot(0.5 * (momentum[1:] + momentum[:-1]), np.diff(whole, axis=0))
    running = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray((running - _dot(whole - track.rotation_rad_s, momentum)) * M2_PER_KM2)


def balance_terms(track: Track) -> dict[str, Floats]:
    """Return every term of the balance along ``track`` as a series, m2/s2, each of shape (n,).

    Notes
    -----
    ``kinetic`` v^2/2; ``rotation`` -w.(r x v); ``potential`` U; ``normal_potential`` U0; ``disturbing_potential``
    T = U - U0; ``dissipation`` int a.(v - w x r) dt; ``tidal_work`` int grad(V_d + V_s).(v - w x r) dt; ``sun``,
    ``moon`` V_d and ``solid_tide_sun``, ``solid_tide_moon`` V_s where they act; ``frame_rate`` as in
    `frame_rate_m2_s2` (ENERGY).
    """
    r_itrf_km = track.r_itrf_km
    potential = track.field.potential_km2_s2(r_itrf_km) * M2_PER_KM2
    normal = normal_field(track.field.degree).potential_km2_s2(r_itrf_km) * M2_PER_KM2
    terms = {
        "kinetic": kinetic_m2_s2(track),
        "rotation": rotation_m2_s2(track),
        "potential": potential,
        "normal_potential": normal,
        "disturbing_potential": potential - normal,
        "dissipation": work_m2_s2(track.t_s, _dot(track.a_km_s2, track.v_earth_km_s)),
        "frame_rate": frame_rate_m2_s2(track),
    }
    return terms | _tidal_terms(track)


def _tidal_terms(track: Track) -> dict[str, Floats]:
    bodies_km = sun_moon_positions_km(track.t_s, track.tables)
    force_km_s2 = np.zeros_like(track.r_km)
    terms: dict[str, Floats] = {}
    for k, (name, gm) in enumerate(BODIES.items()):
        d_km = bodies_km[:, k]
        if track.has_third_bodies:
            terms[name] = third_body_m2_s2(track.r_km, d_km, gm)
            force_km_s2 += third_body_gradient_km_s2(track.r_km, d_km, gm)
        if track.has_tide:
            terms[f"solid_tide_{name}"] = solid_tide_m2_s2(track.r_km, d_km, gm)
            force_km_s2 += solid_tide_gradient_km_s2(track.r_km, d_km, gm)
    return {"tidal_work": work_m2_s2(track.t_s, _dot(force_km_s2, track.v_earth_km_s))} | terms


def static_tide(terms: Series) -> Floats:
    """Return the sum of the tidal potentials that act, shape (n,), m2/s2."""
    acting = [terms[name] for name in ("sun", "moon", "solid_tide_sun", "solid_tide_moon") if name in terms]
    return np.asarray(sum(acting, np.zeros_like(terms["kinetic"])))


def inertial_work_m2_s2(track: Track) -> Floats:
    """Return the work of the non-gravitational acceleration against the inertial velocity, shape (n,), m2/s2."""
    return work_m2_s2(track.t_s, _dot(track.a_km_s2, track.v_km_s))


def printed_m2_s2(track: Track) -> Floats:
    """Return the paper's H + U with its signs, shape (n,), m2/s2: (9) with its dissipation and its (17), (18)."""
    r, v, w = track.r_km, track.v_km_s, EARTH_ROTATION_RAD_S
    braces = (v[:, 0] + w * r[:, 1]) ** 2 + (v[:, 1] - w * r[:, 0]) ** 2 + v[:, 2] ** 2
    again = w * (r[:, 0] * v[:, 1] - r[:, 1] * v[:, 0])
    bodies_km = sun_moon_positions_km(track.t_s, track.tables)
    tides = [printed_tide(r, bodies_km[:, k], gm) for k, gm in enumerate(BODIES.values())] if track.has_tide else []
    return np.asarray((0.5 * braces - again) * M2_PER_KM2 + inertial_work_m2_s2(track) + sum(tides, np.zeros(len(r))))
