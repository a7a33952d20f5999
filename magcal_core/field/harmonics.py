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
from math import factorial, sqrt

import numpy as np

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
    order = max_degree + 1
    knots = len(gauss.knots_ns)
    series = np.zeros((knots, order + 1, order + 1, 6))
    for n in range(1, max_degree + 1):
        for m in range(n + 1):
            schmidt = sqrt((1 if m == 0 else 2) * factorial(n - m) / factorial(n + m))
            _add_gradient(series, n, m, gauss.g_nt[:, n, m] * schmidt, gauss.h_nt[:, n, m] * schmidt)
    scale, recursion = _scaled_recursion(order)
    series *= scale[None, :, :, None]
    return ComponentSeries(
        value_nt=np.ascontiguousarray(series[:-1]),
        slope_nt=np.ascontiguousarray(np.diff(series, axis=0)),
        recursion=recursion,
    )


def _add_gradient(series: Floats, n: int, m: int, c: Floats, s: Floats) -> None:
    """Add the field -grad(a (c V_nm + s W_nm)); columns hold (V, -W) of x, y, z."""
    up, level = series[:, m + 1, n + 1], series[:, m, n + 1]
    level[:, 4] += (n - m + 1) * c
    level[:, 5] -= (n - m + 1) * s
    if m == 0:
        up[:, 0] += c
        up[:, 3] -= c
        return
    up[:, 0] += 0.5 * c
    up[:, 1] -= 0.5 * s
    up[:, 2] -= 0.5 * s
    up[:, 3] -= 0.5 * c
    down = series[:, m - 1, n + 1]
    weight = 0.5 * (n - m + 2) * (n - m + 1)
    down[:, 0] -= weight * c
    down[:, 1] += weight * s
    down[:, 2] -= weight * s
    down[:, 3] -= weight * c


def _scaled_recursion(order: int) -> tuple[Floats, Floats]:
    """Return scale_nm, [m, n], and the recursion of Q_nm = K_nm / scale_nm, in which q has the factor 1."""
    scale = np.zeros((order + 1, order + 1))
    recursion = np.zeros_like(scale)
    sectorial = 1.0
    for m in range(order + 1):
        sectorial *= max(2 * m - 1, 1)
        scale[m, m] = sectorial
        if m < order:
            scale[m, m + 1] = (2 * m + 1) * sectorial
        for n in range(m + 2, order + 1):
            scale[m, n] = (n + m - 1) / (n - m) * scale[m, n - 2]
            recursion[m, n] = (2 * n - 1) / (n - m) * scale[m, n - 1] / scale[m, n]
    return scale, recursion
