"""Motion of a body under the torque of its own dipole in the field: coils that damp it, a magnet, hysteresis rods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import from_rotation_vector, multiply, unit

STEP_S: Final = 1.0
"""Step of the integration: 1/100 of the swing of a strong magnet."""
_SQUARE: Final = 0.55
"""Remanence of a rod over its saturation: apparent, of short rods."""


@dataclass(frozen=True, slots=True, eq=False)
class MagneticBody:
    """A body with coils, a magnet and rods.

    Attributes
    ----------
    moments_kg_m2 : shape (3,)
        Principal moments along the body axes, kg m2.
    damping_a_m2_s_per_t : float
        The coils' dipole is minus this times the rate of the field in body axes, T/s: the B-dot law.
    magnet_a_m2 : shape (3,)
        Dipole of the magnet, body axes, A m2.
    rod_a_m2, coercive_t : float
        Saturation of a rod along the first and of one along the second axis, A m2, and its coercive field, T.
    """

    moments_kg_m2: Floats
    damping_a_m2_s_per_t: float
    magnet_a_m2: Floats
    rod_a_m2: float
    coercive_t: float


@dataclass(frozen=True, slots=True, eq=False)
class IntegratedMotion:
    """Attitudes, shape (m, 4), and rates, shape (m, 3), rad/s, every `STEP_S` since the start."""

    q: Floats
    rate_rad_s: Floats

    def attitude(self, t_s: Floats) -> Floats:
        """Return the attitudes at ``t_s``, shape (n, 4): from the step before, turned at its rate."""
        step = np.clip(np.floor(t_s / STEP_S).astype(np.intp), 0, len(self.q) - 1)
        turn = from_rotation_vector((t_s - step * STEP_S)[:, None] * self.rate_rad_s[step])
        return unit(multiply(self.q[step], turn))


def integrated(body: MagneticBody, b_gcrf_nt: Floats, q0: Floats, rate_rad_s: Floats) -> IntegratedMotion:
    """Return the motion from attitude ``q0``, shape (4,), and ``rate_rad_s``, shape (3,), body axes.

    ``b_gcrf_nt``, shape (m, 3): the field every `STEP_S` along the way, nT, GCRF.

    Notes
    -----
    Runge-Kutta of fourth order on q' = q o w / 2 and J w' = J w x w + m x B with the field straight between steps. A
    rod's dipole is m_s 2/pi atan(p (B_i -+ B_c)), - where B_i rises: p such that its remanence is that of short rods.
    """
    fields_t = np.ascontiguousarray(b_gcrf_nt * 1e-9)
    q, rate = np.empty((len(fields_t), 4)), np.empty((len(fields_t), 3))
    q[0], rate[0] = unit(q0), rate_rad_s
    steep_per_t = np.tan(0.5 * np.pi * _SQUARE) / body.coercive_t
    figures = np.array([body.damping_a_m2_s_per_t, body.rod_a_m2, body.coercive_t, steep_per_t])
    _integrate(fields_t, STEP_S, body.moments_kg_m2, body.magnet_a_m2, figures, q, rate)
    return IntegratedMotion(q, rate)


@njit(cache=True, nogil=True)
def _slope(  # noqa: PLR0917 (numba takes no keyword arguments) # pragma: no cover - compiled
    y: Floats, field: Floats, moving: Floats, moments: Floats, magnet: Floats, figures: Floats
) -> Floats:
    out = np.empty(7)
    a, v, w = y[0], y[1:4], y[4:7]
    direct = a * a - (v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    along = 2.0 * (v[0] * field[0] + v[1] * field[1] + v[2] * field[2])
    along_moving = 2.0 * (v[0] * moving[0] + v[1] * moving[1] + v[2] * moving[2])
    b, rate_b = np.empty(3), np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        b[i] = direct * field[i] + along * v[i] - 2.0 * a * (v[j] * field[k] - v[k] * field[j])
        rate_b[i] = direct * moving[i] + along_moving * v[i] - 2.0 * a * (v[j] * moving[k] - v[k] * moving[j])
    dipole = np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rate_b[i] -= w[j] * b[k] - w[k] * b[j]
        dipole[i] = magnet[i] - figures[0] * rate_b[i]
        if i < 2:
            away = b[i] - figures[2] * np.sign(rate_b[i])
            dipole[i] += figures[1] * 2.0 / np.pi * np.arctan(figures[3] * away)
    out[0] = -0.5 * (v[0] * w[0] + v[1] * w[1] + v[2] * w[2])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[1 + i] = 0.5 * (a * w[i] + v[j] * w[k] - v[k] * w[j])
        torque = dipole[j] * b[k] - dipole[k] * b[j] + (moments[j] - moments[k]) * w[j] * w[k]
        out[4 + i] = torque / moments[i]
    return out


@njit(cache=True, nogil=True)
def _integrate(  # noqa: PLR0917 (numba takes no keyword arguments) # pragma: no cover - compiled
    fields: Floats, step_s: float, moments: Floats, magnet: Floats, figures: Floats, q: Floats, rate: Floats
) -> None:
    y = np.empty(7)
    y[:4], y[4:] = q[0], rate[0]
    for n in range(len(fields) - 1):
        first, last = fields[n], fields[n + 1]
        moving, middle = (last - first) / step_s, 0.5 * (first + last)
        k1 = _slope(y, first, moving, moments, magnet, figures)
        k2 = _slope(y + 0.5 * step_s * k1, middle, moving, moments, magnet, figures)
        k3 = _slope(y + 0.5 * step_s * k2, middle, moving, moments, magnet, figures)
        k4 = _slope(y + step_s * k3, last, moving, moments, magnet, figures)
        y = y + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        y[:4] /= np.sqrt(np.sum(y[:4] ** 2))
        q[n + 1], rate[n + 1] = y[:4], y[4:]
