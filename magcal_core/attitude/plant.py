"""The body and its wheels: what a torque does to the attitude on a circular orbit.

Vectors are triples and quaternions quadruples inside the compiled functions: no allocation in the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import InputError
from magcal_core.numerics.kernel import kernel

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
State: TypeAlias = tuple[Quaternion, Vector, Vector]
"""Attitude q (orbital to body axes), inertial rate in body axes, rad/s, and wheel momentum in body axes, Nms."""

INERTIA_KG_M2: Final = (70.0, 90.0, 80.0)
"""Principal moments of the 350 kg satellite that the ROM figures are for, kg m2."""


def inertia_matrix(values: Sequence[float]) -> Floats:
    """Return the inertia matrix, kg m2, shape (3, 3), from Jx, Jy, Jz and, where given, the elements Jxy, Jxz, Jyz.

    Raises
    ------
    InputError
        Neither three nor six numbers.
    """
    if len(values) not in (3, 6):
        raise InputError(f"an inertia has 3 or 6 numbers (Jx, Jy, Jz, Jxy, Jxz, Jyz), not {len(values)}")
    matrix = np.diag(np.asarray(values[:3], dtype=np.float64))
    for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), values[3:], strict=False):
        matrix[i, j] = matrix[j, i] = value
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A rigid satellite with three reaction wheels along its axes.

    Attributes
    ----------
    inertia_kg_m2 : shape (3, 3)
        Inertia in body axes, wheels at rest included, kg m2.
    torque_limit_nm, momentum_limit_nms : float
        Largest torque, Nm, and angular momentum, Nms, of each wheel.
    has_gravity_gradient : bool
        Whether the gravity gradient turns the body.

    Raises
    ------
    InputError
        The inertia is not that of a body, or a limit is not positive.
    """

    inertia_kg_m2: Floats = field(default_factory=lambda: inertia_matrix(INERTIA_KG_M2))
    torque_limit_nm: float = 0.05
    momentum_limit_nms: float = 5.0
    has_gravity_gradient: bool = False

    def __post_init__(self) -> None:
        inertia = self.inertia_kg_m2
        if inertia.shape != (3, 3) or not np.all(np.isfinite(inertia)) or not np.allclose(inertia, inertia.T):
            raise InputError("the inertia must be a symmetric 3 x 3 matrix of finite numbers, kg m2")
        moments = np.linalg.eigvalsh(inertia)
        if moments[0] <= 0.0 or moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-9):
            raise InputError(
                f"no body has the principal moments {moments.round(6).tolist()} kg m2: "
                "each must be positive and at most the sum of the other two"
            )
        if not (self.torque_limit_nm > 0.0 and self.momentum_limit_nms > 0.0):
            raise InputError("the wheels' torque and momentum limits must be positive, Nm and Nms")


class Mechanics(NamedTuple):
    """What the equations of motion know of body and orbit.

    ``inertia`` and ``inverse`` in kg m2 and its inverse, ``orbital_rate`` n in rad/s, ``gradient`` 3 n^2 where the
    gravity gradient acts, else 0.
    """

    inertia: Floats
    inverse: Floats
    orbital_rate: float
    gradient: float


def mechanics_of(body: Body, orbital_rate_rad_s: float) -> Mechanics:
    """Return the constants of the equations of motion of ``body`` on an orbit with this rate."""
    gradient = 3.0 * orbital_rate_rad_s**2 if body.has_gravity_gradient else 0.0
    inertia = np.ascontiguousarray(body.inertia_kg_m2, dtype=np.float64)
    return Mechanics(inertia, np.ascontiguousarray(np.linalg.inv(inertia)), orbital_rate_rad_s, gradient)


@kernel()
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel()
def dot(a: Vector, b: Vector) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel()
def times(matrix: Floats, v: Vector) -> Vector:
    """Return the product of a matrix, shape (3, 3), and a vector."""
    return (
        matrix[0, 0] * v[0] + matrix[0, 1] * v[1] + matrix[0, 2] * v[2],
        matrix[1, 0] * v[0] + matrix[1, 1] * v[1] + matrix[1, 2] * v[2],
        matrix[2, 0] * v[0] + matrix[2, 1] * v[1] + matrix[2, 2] * v[2],
    )


@kernel()
def turned(q: Quaternion, v: Vector) -> Vector:
    """Return C(q) v: the vector in the axes that q leads to."""
    u = (q[1], q[2], q[3])
    c = cross(u, v)
    along, square = 2.0 * dot(u, v), q[0] * q[0] - dot(u, u)
    return (
        square * v[0] + along * u[0] - 2.0 * q[0] * c[0],
        square * v[1] + along * u[1] - 2.0 * q[0] * c[1],
        square * v[2] + along * u[2] - 2.0 * q[0] * c[2],
    )


@kernel()
def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the quaternion product a o b."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + b[0] * a[1] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] + b[0] * a[2] + a[3] * b[1] - a[1] * b[3],
        a[0] * b[3] + b[0] * a[3] + a[1] * b[2] - a[2] * b[1],
    )


@kernel()
def limited_torque(torque: Vector, h: Vector, torque_limit_nm: float, momentum_limit_nms: float, dt_s: float) -> Vector:
    """Return what the wheels can give of ``torque``, Nm, for ``dt_s``: each within its torque and momentum limits."""
    lowest = (h[0] - momentum_limit_nms, h[1] - momentum_limit_nms, h[2] - momentum_limit_nms)
    highest = (h[0] + momentum_limit_nms, h[1] + momentum_limit_nms, h[2] + momentum_limit_nms)
    x = min(max(torque[0], -torque_limit_nm, lowest[0] / dt_s), torque_limit_nm, highest[0] / dt_s)
    y = min(max(torque[1], -torque_limit_nm, lowest[1] / dt_s), torque_limit_nm, highest[1] / dt_s)
    z = min(max(torque[2], -torque_limit_nm, lowest[2] / dt_s), torque_limit_nm, highest[2] / dt_s)
    return (x, y, z)


@kernel()
def _rates(state: State, torque: Vector, mechanics: Mechanics) -> tuple[Quaternion, Vector]:
    """Return dq/dt and dw/dt."""
    q, w, h = state
    orbital = turned(q, (0.0, 0.0, -mechanics.orbital_rate))
    spin = product(q, (0.0, w[0] - orbital[0], w[1] - orbital[1], w[2] - orbital[2]))
    momentum = times(mechanics.inertia, w)
    gyroscopic = cross(w, (momentum[0] + h[0], momentum[1] + h[1], momentum[2] + h[2]))
    up = turned(q, (0.0, 1.0, 0.0))
    gravity = cross(up, times(mechanics.inertia, up))
    total = (
        torque[0] - gyroscopic[0] + mechanics.gradient * gravity[0],
        torque[1] - gyroscopic[1] + mechanics.gradient * gravity[1],
        torque[2] - gyroscopic[2] + mechanics.gradient * gravity[2],
    )
    return (0.5 * spin[0], 0.5 * spin[1], 0.5 * spin[2], 0.5 * spin[3]), times(mechanics.inverse, total)


@kernel()
def _moved(state: State, torque: Vector, rates: tuple[Quaternion, Vector], step_s: float) -> State:
    """Return the state after ``step_s`` at constant rates of change."""
    q, w, h = state
    dq, dw = rates
    return (
        (q[0] + step_s * dq[0], q[1] + step_s * dq[1], q[2] + step_s * dq[2], q[3] + step_s * dq[3]),
        (w[0] + step_s * dw[0], w[1] + step_s * dw[1], w[2] + step_s * dw[2]),
        (h[0] - step_s * torque[0], h[1] - step_s * torque[1], h[2] - step_s * torque[2]),
    )


@kernel()
def advance(state: State, torque: Vector, mechanics: Mechanics, dt_s: float) -> State:
    """Return the state after ``dt_s`` under a constant torque, Nm, by one Runge-Kutta step of fourth order.

    Notes
    -----
    ``J w' = L - w x (J w + h) + 3 n^2 y x J y``, ``h' = -L``, ``q' = q o (w - C w_o) / 2``, ``w_o = (0, 0, -n)``
    (`docs/references.md`: ROM).
    """
    k1 = _rates(state, torque, mechanics)
    k2 = _rates(_moved(state, torque, k1, 0.5 * dt_s), torque, mechanics)
    k3 = _rates(_moved(state, torque, k2, 0.5 * dt_s), torque, mechanics)
    k4 = _rates(_moved(state, torque, k3, dt_s), torque, mechanics)
    s = dt_s / 6.0
    state = _moved(state, (0.0, 0.0, 0.0), k1, s)
    state = _moved(state, (0.0, 0.0, 0.0), k2, 2.0 * s)
    state = _moved(state, (0.0, 0.0, 0.0), k3, 2.0 * s)
    q, w, h = _moved(state, (6.0 * torque[0], 6.0 * torque[1], 6.0 * torque[2]), k4, s)
    norm = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm), w, h
