"""The forces on a satellite: gravity of the turning Earth, Sun and Moon, solid tide and drag, as compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt
from typing import Final, Literal, NamedTuple

import erfa
import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.constants import EARTH_ROTATION_RAD_S, MOON_GM_KM3_S2, SUN_GM_KM3_S2
from magcal_core.errors import OptionError
from magcal_core.numerics.kernel import kernel
from magcal_core.orbit.earth.bodies import EphemerisName, sun_moon_gcrf
from magcal_core.orbit.earth.eop import earth_orientation
from magcal_core.orbit.earth.frames import ERA_RATE_RAD_S, cip_coordinates, polar_motion_matrix
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.orbit.propagators.gravity import GravityField, fill_solid_harmonics, gradient_from_harmonics

RotationName = Literal["iers", "uniform"]

NODE_S: Final = 600.0
"""Spacing of the tables of Earth rotation, Sun and Moon, s."""
LOVE_NUMBER_K2: Final = 0.30
"""Degree-2 potential Love number of the solid Earth (ENERGY)."""

_GM_BODIES: Final = np.array([SUN_GM_KM3_S2, MOON_GM_KM3_S2])


@dataclass(frozen=True, slots=True)
class ExponentialDrag:
    """Drag in an atmosphere that turns with the Earth: rho = rho0 exp(-(r - r0)/H).

    Attributes
    ----------
    density_kg_m3 : float
        rho0, at the radius ``reference_radius_km`` from the geocentre.
    area_drag_over_mass_m2_kg : float
        Cd A / m, m2/kg.
    scale_height_km : float
        H, km.
    """

    density_kg_m3: float
    area_drag_over_mass_m2_kg: float
    reference_radius_km: float
    scale_height_km: float = 65.0

    def __post_init__(self) -> None:
        values = (self.density_kg_m3, self.area_drag_over_mass_m2_kg)
        if not (all(np.isfinite(v) and v >= 0 for v in values) and self.scale_height_km > 0):
            raise OptionError("drag needs a density and an area over mass of 0 or more and a scale height above 0 km")


class ForceTables(NamedTuple):
    """Earth rotation, Sun and Moon on nodes `NODE_S` apart; times are seconds since the orbit's epoch."""

    first_node: int
    """Number of the first node; node 0 is at the epoch."""
    cio: Floats
    """GCRF to the celestial intermediate frame, shape (k, 3, 3)."""
    polar: Floats
    """Terrestrial intermediate frame to ITRF, shape (k, 3, 3)."""
    era_rad: Floats
    """Earth rotation angle without jumps, shape (k,), rad."""
    bodies_km: Floats
    """Sun and Moon, shape (k, 2, 3), GCRF, km."""
    bodies_km_s: Floats
    """Their velocities, shape (k, 2, 3), GCRF, km/s."""

    @property
    def from_s(self) -> float:
        """First time that the tables are good for, s since the epoch."""
        return (self.first_node + 1) * NODE_S

    @property
    def until_s(self) -> float:
        """Last time that the tables are good for, s since the epoch."""
        return (self.first_node + len(self.era_rad) - 2) * NODE_S


class ForceModel(NamedTuple):
    """Which forces act, as the kernels want it."""

    c: Floats
    """Unnormalised cosine coefficients, shape (degree+1, degree+1), as ``[m, n]``."""
    s: Floats
    gm_km3_s2: float
    radius_km: float
    has_third_bodies: bool
    k2: float
    """Love number; 0 leaves the solid tide out."""
    drag_per_km: float
    """rho0 Cd A / m, 1/km; 0 leaves drag out."""
    drag_radius_km: float
    drag_height_km: float


def force_model(
    field: GravityField, third_bodies: bool = True, k2: float = 0.0, drag: ExponentialDrag | None = None
) -> ForceModel:
    """Return the forces in the form that the kernels take."""
    c, s = field.unnormalised()
    per_km = 0.0 if drag is None else 1e3 * drag.density_kg_m3 * drag.area_drag_over_mass_m2_kg
    radius_km, height_km = (1.0, 1.0) if drag is None else (drag.reference_radius_km, drag.scale_height_km)
    return ForceModel(
        c, s, field.gm_km3_s2, field.radius_km, bool(third_bodies), float(k2), per_km, radius_km, height_km
    )


def force_tables(
    epoch_utc: np.datetime64,
    from_s: float,
    until_s: float,
    ephemeris: EphemerisName = "de421",
    rotation: RotationName = "iers",
) -> ForceTables:
    """Return tables that cover ``from_s`` to ``until_s``, seconds since ``epoch_utc``, and one node more on each side.

    Raises
    ------
    ModelRangeError
        Earth orientation or the ephemeris does not reach the dates.

    Notes
    -----
    Nodes are whole multiples of `NODE_S` from the epoch, so that a longer table repeats a shorter one exactly.
    ``uniform`` is the ideal Earth of energy studies: turning about the z of GCRF at 7.292115e-5 rad/s.
    """
    first, last = int(np.floor(from_s / NODE_S)) - 1, int(np.ceil(until_s / NODE_S)) + 1
    t_s = np.arange(first, last + 1) * NODE_S
    stamps_ns = int(nanoseconds(np.array([epoch_utc]))[0]) + np.round(t_s * 1e9).astype(np.int64)
    t_utc = stamps_ns.view("datetime64[ns]")
    bodies_km, bodies_km_s = sun_moon_gcrf(t_utc, ephemeris)
    if rotation == "uniform":
        identity = np.broadcast_to(np.eye(3), (len(t_s), 3, 3)).copy()
        return ForceTables(
            first, identity, identity, np.asarray(EARTH_ROTATION_RAD_S * t_s, np.float64), bodies_km, bodies_km_s
        )
    if rotation != "iers":
        raise OptionError(f"unknown Earth rotation {rotation!r}; known are iers, uniform")
    cio = np.asarray(erfa.c2ixys(*cip_coordinates(t_utc)))
    nominal_rad = ERA_RATE_RAD_S * t_s
    at_epoch_rad = float(_era_rad(np.array([epoch_utc], "datetime64[ns]"))[0])
    off_rad = np.remainder(_era_rad(t_utc) - nominal_rad - at_epoch_rad + np.pi, 2 * np.pi) - np.pi
    era_rad: Floats = nominal_rad + (at_epoch_rad + off_rad)
    return ForceTables(first, cio, polar_motion_matrix(t_utc), era_rad, bodies_km, bodies_km_s)


def _era_rad(t_utc: Times) -> Floats:
    return np.asarray(erfa.era00(*earth_orientation().julian_ut1(t_utc)))


@kernel()
def node_of(t_s: float, tables: ForceTables) -> tuple[int, float]:
    """Return the node before ``t_s`` and the part of a node interval after it."""
    node = np.floor(t_s / NODE_S)
    return int(node) - tables.first_node, t_s / NODE_S - node


@kernel()
def celestial_to_terrestrial(t_s: float, tables: ForceTables, out: Floats) -> None:
    """Fill ``out``, shape (3, 3), with the rotation from GCRF to ITRF at ``t_s``: W R3(ERA) C (IERS2010)."""
    i, x = node_of(t_s, tables)
    era = tables.era_rad[i] + x * (tables.era_rad[i + 1] - tables.era_rad[i])
    cos, sin = np.cos(era), np.sin(era)
    c0, c1, w0, w1 = tables.cio[i], tables.cio[i + 1], tables.polar[i], tables.polar[i + 1]
    for k in range(3):
        a = c0[0, k] + x * (c1[0, k] - c0[0, k])
        b = c0[1, k] + x * (c1[1, k] - c0[1, k])
        c = c0[2, k] + x * (c1[2, k] - c0[2, k])
        a, b = cos * a + sin * b, cos * b - sin * a
        for j in range(3):
            wa = w0[j, 0] + x * (w1[j, 0] - w0[j, 0])
            wb = w0[j, 1] + x * (w1[j, 1] - w0[j, 1])
            wc = w0[j, 2] + x * (w1[j, 2] - w0[j, 2])
            out[j, k] = wa * a + wb * b + wc * c


@kernel()
def body_position(t_s: float, body: int, tables: ForceTables) -> tuple[float, float, float]:
    """Return Sun (0) or Moon (1) at ``t_s``, GCRF, km, by cubic Hermite interpolation."""
    i, x = node_of(t_s, tables)
    h11 = x * x * (x - 1.0) * NODE_S
    h10 = x * (x - 1.0) * (x - 1.0) * NODE_S
    h01 = x * x * (3.0 - 2.0 * x)
    p, v = tables.bodies_km, tables.bodies_km_s
    x0 = p[i, body, 0] + h01 * (p[i + 1, body, 0] - p[i, body, 0]) + h10 * v[i, body, 0] + h11 * v[i + 1, body, 0]
    x1 = p[i, body, 1] + h01 * (p[i + 1, body, 1] - p[i, body, 1]) + h10 * v[i, body, 1] + h11 * v[i + 1, body, 1]
    x2 = p[i, body, 2] + h01 * (p[i + 1, body, 2] - p[i, body, 2]) + h10 * v[i, body, 2] + h11 * v[i + 1, body, 2]
    return x0, x1, x2


@kernel()
def _tide_factors(c: float, r: float, d: float, gm: float, k2: float, radius: float) -> tuple[float, float]:  # noqa: PLR0917
    """Return the radial and the towards-the-body part of the solid tide's acceleration, km/s2; ``c`` is cos Theta."""
    scale = 0.5 * k2 * gm / d**3 * radius**5 / r**4
    return scale * (3.0 - 15.0 * c * c), scale * 6.0 * c


@kernel()
def acceleration(t_s: float, y: Floats, tables: ForceTables, model: ForceModel, work: Floats, out: Floats) -> None:  # noqa: PLR0917
    """Fill ``out[3:]`` with the acceleration, GCRF, km/s2, at position and velocity ``y``, shape (6,), km and km/s.

    ``work`` has shape (3, degree+3, degree+3): two tables of solid harmonics and a rotation.

    Notes
    -----
    a = M^T grad U(M r) + sum GM_d [(d - r)/|d - r|^3 - d/d^3] + k2 tide + drag, d over Sun and Moon (IERS2010, ENERGY).
    """
    v, w, m = work[0], work[1], work[2]
    rx, ry, rz = y[0], y[1], y[2]
    celestial_to_terrestrial(t_s, tables, m)
    ex = m[0, 0] * rx + m[0, 1] * ry + m[0, 2] * rz
    ey = m[1, 0] * rx + m[1, 1] * ry + m[1, 2] * rz
    ez = m[2, 0] * rx + m[2, 1] * ry + m[2, 2] * rz
    degree = model.c.shape[0] - 1
    fill_solid_harmonics(ex, ey, ez, model.radius_km, degree + 1, v, w)
    gx, gy, gz = gradient_from_harmonics(model.c, model.s, degree, v, w)
    scale = model.gm_km3_s2 / model.radius_km**2
    ax = scale * (m[0, 0] * gx + m[1, 0] * gy + m[2, 0] * gz)
    ay = scale * (m[0, 1] * gx + m[1, 1] * gy + m[2, 1] * gz)
    az = scale * (m[0, 2] * gx + m[1, 2] * gy + m[2, 2] * gz)
    r = sqrt(rx * rx + ry * ry + rz * rz)
    if model.has_third_bodies or model.k2 != 0.0:
        for body in range(2):
            dx, dy, dz = body_position(t_s, body, tables)
            d = sqrt(dx * dx + dy * dy + dz * dz)
            gm = _GM_BODIES[body]
            if model.has_third_bodies:
                px, py, pz = dx - rx, dy - ry, dz - rz
                near, far = gm / sqrt(px * px + py * py + pz * pz) ** 3, gm / d**3
                ax += near * px - far * dx
                ay += near * py - far * dy
                az += near * pz - far * dz
            if model.k2 != 0.0:
                cosine = (rx * dx + ry * dy + rz * dz) / (r * d)
                radial, towards = _tide_factors(cosine, r, d, gm, model.k2, model.radius_km)
                ax += radial * rx / r + towards * dx / d
                ay += radial * ry / r + towards * dy / d
                az += radial * rz / r + towards * dz / d
    if model.drag_per_km != 0.0:
        tx, ty, tz = drag_acceleration(t_s, y, tables, model)
        ax, ay, az = ax + tx, ay + ty, az + tz
    out[0], out[1], out[2] = y[3], y[4], y[5]
    out[3], out[4], out[5] = ax, ay, az


@kernel()
def drag_acceleration(t_s: float, y: Floats, tables: ForceTables, model: ForceModel) -> tuple[float, float, float]:
    """Return the acceleration by drag, GCRF, km/s2: -rho Cd A / (2 m) |u| u with u = v - w x r, w along the CIP."""
    i, x = node_of(t_s, tables)
    wx = EARTH_ROTATION_RAD_S * (tables.cio[i, 2, 0] + x * (tables.cio[i + 1, 2, 0] - tables.cio[i, 2, 0]))
    wy = EARTH_ROTATION_RAD_S * (tables.cio[i, 2, 1] + x * (tables.cio[i + 1, 2, 1] - tables.cio[i, 2, 1]))
    wz = EARTH_ROTATION_RAD_S * (tables.cio[i, 2, 2] + x * (tables.cio[i + 1, 2, 2] - tables.cio[i, 2, 2]))
    ux = y[3] - (wy * y[2] - wz * y[1])
    uy = y[4] - (wz * y[0] - wx * y[2])
    uz = y[5] - (wx * y[1] - wy * y[0])
    r = sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    density = model.drag_per_km * exp(-(r - model.drag_radius_km) / model.drag_height_km)
    scale = -0.5 * density * sqrt(ux * ux + uy * uy + uz * uz)
    return scale * ux, scale * uy, scale * uz


@kernel()
def _matrices(t_s: Floats, tables: ForceTables) -> Floats:
    out = np.empty((t_s.shape[0], 3, 3))
    for k in range(t_s.shape[0]):
        celestial_to_terrestrial(t_s[k], tables, out[k])
    return out


@kernel()
def _bodies(t_s: Floats, tables: ForceTables) -> Floats:
    out = np.empty((t_s.shape[0], 2, 3))
    for k in range(t_s.shape[0]):
        for body in range(2):
            out[k, body, 0], out[k, body, 1], out[k, body, 2] = body_position(t_s[k], body, tables)
    return out


@kernel()
def drag_accelerations(t_s: Floats, y: Floats, tables: ForceTables, model: ForceModel) -> Floats:
    """Return the acceleration by drag at states ``y``, shape (n, 6), km and km/s: shape (n, 3), GCRF, km/s2."""
    out = np.empty((t_s.shape[0], 3))
    for k in range(t_s.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = drag_acceleration(t_s[k], y[k], tables, model)
    return out


def gcrf_to_itrf_matrices(t_s: Floats, tables: ForceTables) -> Floats:
    """Return the rotations from GCRF to ITRF that the forces use, at ``t_s`` since the epoch, shape (n, 3, 3)."""
    return np.asarray(_matrices(np.ascontiguousarray(t_s), tables))


def sun_moon_positions_km(t_s: Floats, tables: ForceTables) -> Floats:
    """Return Sun and Moon as the forces use them, at ``t_s`` since the epoch, shape (n, 2, 3), GCRF, km."""
    return np.asarray(_bodies(np.ascontiguousarray(t_s), tables))


def cip_axis_gcrf(t_s: Floats, tables: ForceTables) -> Floats:
    """Return the unit vector of the celestial intermediate pole at ``t_s`` since the epoch, shape (n, 3), GCRF."""
    nodes_s = NODE_S * (tables.first_node + np.arange(len(tables.era_rad)))
    axis = np.stack([np.interp(t_s, nodes_s, tables.cio[:, 2, k]) for k in range(3)], axis=1)
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))
