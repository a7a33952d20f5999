"""The ROM control law, compiled: from a measured field, a model field and a rate to the torque of the wheels.

Errors of the printed formulas and their correction are in `docs/attitude.md`; the source is `docs/references.md`: ROM.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from magcal_core.attitude.plant import Quaternion, Vector, cross, dot, product, turned
from magcal_core.numerics.kernel import kernel

DEGENERATE: Final = 1e-8
"""Length of q~ below which its direction is lost: the measured field is opposite to the model."""
GUARDED: Final = 0.05
"""Length of q~ below which the guarded law turns away from the degenerate set."""


class Law(NamedTuple):
    """Gains and form of the control law: kp in Nm, kd in Nms, n in rad/s; ``guard`` is the least usable |q~|."""

    kp: float
    kd: float
    orbital_rate: float
    is_printed: bool
    guard: float


@kernel()
def minimal_quaternion(alpha: Vector, b: Vector, guard: float) -> tuple[Quaternion, float]:
    """Return the smallest turn theta with ``C(theta) b = alpha``, and |q~|, from two unit vectors.

    Notes
    -----
    (1.1): ``q~ = (1 + alpha . b, alpha x b)``, ``theta = q~ / |q~|``. Where the vectors are opposite every half turn
    about an axis across b will do; the axis taken is across b and the coordinate axis farthest from b.
    """
    v = cross(alpha, b)
    scalar = 1.0 + dot(alpha, b)
    norm = np.sqrt(scalar * scalar + dot(v, v))
    if norm >= guard:
        return (scalar / norm, v[0] / norm, v[1] / norm, v[2] / norm), norm
    x, y, z = abs(b[0]), abs(b[1]), abs(b[2])
    if x <= y and x <= z:
        e = (0.0, b[2], -b[1])
    elif y <= z:
        e = (-b[2], 0.0, b[0])
    else:
        e = (b[1], -b[0], 0.0)
    length = np.sqrt(dot(e, e))
    return (0.0, e[0] / length, e[1] / length, e[2] / length), norm


@kernel()
def command(
    law: Law, alpha: Vector, b: Vector, rate: Vector, programme: tuple[Quaternion, Vector]
) -> tuple[Vector, float]:
    """Return the torque that the law asks for, Nm, body axes, and |q~|.

    ``alpha`` is the measured field direction in body axes, ``b`` the model's in orbital axes, ``rate`` the measured
    inertial rate, rad/s; ``programme`` is the turn from orbital to programmed axes and its rate in the latter, rad/s.

    Notes
    -----
    (1.2), (2.3) corrected: ``w_r = w - S P w_o - S w_p``, S the matrix of the minimal turn, programmed to body axes;
    printed: ``w - S w_o - S P w_p``. (1.3) corrected: ``theta' = theta o w_r / 2``; printed: ``w_r o theta / 2``.
    (1.4): ``L = -kp theta_v - kd theta'_v``.
    """
    turn, turn_rate = programme
    theta, norm = minimal_quaternion(alpha, turned(turn, b), law.guard)
    w_o = (0.0, 0.0, -law.orbital_rate)
    if law.is_printed:
        orbital, own = turned(theta, w_o), turned(theta, turned(turn, turn_rate))
    else:
        orbital, own = turned(theta, turned(turn, w_o)), turned(theta, turn_rate)
    w_r = (0.0, rate[0] - orbital[0] - own[0], rate[1] - orbital[1] - own[1], rate[2] - orbital[2] - own[2])
    spin = product(w_r, theta) if law.is_printed else product(theta, w_r)
    kd = 0.5 * law.kd
    torque = (
        -law.kp * theta[1] - kd * spin[1],
        -law.kp * theta[2] - kd * spin[2],
        -law.kp * theta[3] - kd * spin[3],
    )
    return torque, norm
