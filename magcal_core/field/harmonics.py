"""From Gauss coefficients to what the kernel sums: each Cartesian component of the field is itself harmonic.

Notes
-----
With a the reference radius, x' = z a / r^2, q = a^2 / r^2 and Z = (x + iy) a / r^2, the solid harmonics are

    V_nm + i W_nm = (a/r)^(n+1) P_nm(z/r) exp(i m lambda) = (a/r) K_nm(x', q) Z^m,
    K_mm = (2m - 1)!!,  K_nm = ((2n - 1) x' K_(n-1)m - (n + m - 1) q K_(n-2)m) / (n - m),

and a derivative of one of degree n is a sum of those of degree n + 1 (Cunningham; equations 3.33 of Montenbruck and
Gill, Satellite Orbits). Nothing is divided by the distance from the axis, so the poles are ordinary points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import factorial, frexp, sqrt

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.field.shc import GaussCoefficients


@dataclass(frozen=True, slots=True, eq=False)
class ComponentSeries:
    """Coefficients of the three Cartesian components over scaled harmonics Q_nm = K_nm / scale_nm.

    Attributes
    ----------
    value_nt, slope_nt : shape (k - 1, L + 1, L + 1, 6)
        At the start of each interval between knots, and the change over it, by order m, degree n and (cosine, minus
        sine) of x, y, z: B = (a/r) Re sum_m Z^m sum_n (c + i s) Q_nm.
    recursion : shape (L + 1, L + 1)
        Q_nm = recursion[m, n] x' Q_(n-1)m - q Q_(n-2)m.
    """

    value_nt: Floats
    slope_nt: Floats
    recursion: Floats


def component_series(gauss: GaussCoefficients, max_degree: int) -> ComponentSeries:
    """Return the series of the field's components from the Gauss coefficients up to ``max_degree``."""
    series, recursion = series_of(gauss.g_nt, gauss.h_nt, 1, max_degree)
    return ComponentSeries(
        value_nt=np.ascontiguousarray(series[:-1]),
        slope_nt=np.ascontiguousarray(np.diff(series, axis=0)),
        recursion=recursion,
    )


def series_of(g_nt: Floats, h_nt: Floats, min_degree: int, max_degree: int) -> tuple[Floats, Floats]:
    """Return the series, shape (k, L + 1, L + 1, 6), L = max_degree + 1, of k sets of coefficients, and the recursion.

    ``g_nt``, ``h_nt`` : shape (k, N + 1, N + 1)
        Schmidt quasi-normalised, nT, of which the degrees from ``min_degree`` to ``max_degree`` count.

    Notes
    -----
    The factors sqrt(2 (n-m)!/(n+m)!) of the normalisation and (2m-1)!! of the harmonics leave the doubles, the one
    beyond degree 85, the other beyond 150; their product does not. Each is kept as a number and a power of two, and the
    powers are added before the numbers are multiplied: that rounds as if there were no bounds.
    """
    order = max_degree + 1
    scale, exponent, recursion = _scaled_recursion(order)
    series = np.zeros((len(g_nt), order + 1, order + 1, 6))
    for n in range(min_degree, max_degree + 1):
        _add_gradients(series[:, :, n + 1], n, exponent, g_nt[:, n, : n + 1], h_nt[:, n, : n + 1])
    series *= scale[None, :, :, None]
    return series, recursion


@cache
def _factorial(n: int) -> int:
    return factorial(n)


def _schmidt(n: int, m: int) -> tuple[float, int]:
    """Return sqrt((2 - [m = 0]) (n-m)!/(n+m)!) as a number near 1 and a power of two."""
    above, below = (1 if m == 0 else 2) * _factorial(n - m), _factorial(n + m)
    half = max(0, (below.bit_length() - above.bit_length()) // 2)
    return sqrt((above << 2 * half) / below), -half


def _add_gradients(to: Floats, n: int, exponent: NDArray[np.int64], g_nt: Floats, h_nt: Floats) -> None:
    """Add the field -grad(a sum_m (c V_nm + s W_nm)) to degree n + 1, (k, L + 1, 6): columns hold (V, -W) of x, y, z.

    A coefficient of order m goes to the orders m - 1, m and m + 1, each of which has its own power of two.
    """
    m = np.arange(n + 1)
    schmidt, power = (np.array(column) for column in zip(*(_schmidt(n, order) for order in range(n + 1)), strict=True))
    level = np.ldexp(schmidt, power + exponent[m])
    up = np.ldexp(schmidt, power + exponent[m + 1])
    down = np.ldexp(schmidt[1:], power[1:] + exponent[m[:-1]])
    to[:, : n + 1, 4] += (n - m + 1) * (g_nt * level)
    to[:, : n + 1, 5] -= (n - m + 1) * (h_nt * level)
    c, s = g_nt * up, h_nt * up
    half = np.where(m == 0, 1.0, 0.5)
    to[:, 1 : n + 2, 0] += half * c
    to[:, 2 : n + 2, 1] -= 0.5 * s[:, 1:]
    to[:, 2 : n + 2, 2] -= 0.5 * s[:, 1:]
    to[:, 1 : n + 2, 3] -= half * c
    c, s = g_nt[:, 1:] * down, h_nt[:, 1:] * down
    weight = 0.5 * (n - m[1:] + 2) * (n - m[1:] + 1)
    to[:, :n, 0] -= weight * c
    to[:, :n, 1] += weight * s
    to[:, :n, 2] -= weight * s
    to[:, :n, 3] -= weight * c


def _scaled_recursion(order: int) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Return scale_nm 2^-e_m, [m, n], the powers e_m, and the recursion of Q_nm = K_nm / scale_nm, where q has 1."""
    scale, exponent = np.zeros((order + 1, order + 1)), np.zeros(order + 1, np.int64)
    recursion = np.zeros_like(scale)
    sectorial, power = 1.0, 0
    for m in range(order + 1):
        sectorial, more = frexp(sectorial * max(2 * m - 1, 1))
        power += more
        scale[m, m], exponent[m] = sectorial, power
        if m < order:
            scale[m, m + 1] = (2 * m + 1) * sectorial
        for n in range(m + 2, order + 1):
            scale[m, n] = (n + m - 1) / (n - m) * scale[m, n - 2]
            recursion[m, n] = (2 * n - 1) / (n - m) * scale[m, n - 1] / scale[m, n]
    return scale, exponent, recursion
