"""Integration of an orbit by DOP853 with dense output, compiled together with the forces.

The compiled kernels are kept on disk by the age of this file alone: after an edit of ``forces.py`` or ``gravity.py``,
touch this one too.
"""

from __future__ import annotations

from math import sqrt
from typing import Final, NamedTuple

import numpy as np
from scipy.integrate import DOP853

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel
from magcal_core.orbit.propagators.forces import NODE_S, ForceModel, ForceTables, acceleration

_STAGES: Final = 12
_A: Final = np.zeros((16, 16))
_A[:12, :12] = DOP853.A
_A[12, :12] = DOP853.B
_A[13:, :] = DOP853.A_EXTRA
_C: Final = np.concatenate([DOP853.C, [1.0], DOP853.C_EXTRA])
_E3: Final = np.ascontiguousarray(DOP853.E3)
_E5: Final = np.ascontiguousarray(DOP853.E5)
_D: Final = np.ascontiguousarray(DOP853.D)

_SAFETY: Final = 0.9
_SHRINK: Final = 0.2
_GROW: Final = 10.0
_SMALLEST_STEP_S: Final = 1e-6

DONE: Final = 0
STEP_TOO_SMALL: Final = 1
BELOW_SURFACE: Final = 2
TOO_MANY_STEPS: Final = 3


class Steps(NamedTuple):
    """Accepted steps of one direction, each with its interpolation polynomial."""

    t_s: Floats
    """Ends of the steps, shape (k+1,), s since the epoch; the first is the epoch."""
    y: Floats
    """Position, km, and velocity, km/s, at ``t_s``, shape (k+1, 6), GCRF."""
    polynomial: Floats
    """Shape (k, 7, 6)."""
    next_step_s: float
    """Signed size of the step that would follow."""
    status: int


@kernel()
def _stage(  # noqa: PLR0917
    s: int, t: float, h: float, y: Floats, k: Floats, tables: ForceTables, model: ForceModel, work: Floats, at: Floats
) -> None:
    for i in range(6):
        total = 0.0
        for j in range(s):
            if _A[s, j] != 0.0:
                total += _A[s, j] * k[j, i]
        at[i] = y[i] + h * total
    acceleration(t + _C[s] * h, at, tables, model, work, k[s])


@kernel()
def _error_norm(h: float, k: Floats, y: Floats, y_new: Floats, rtol: float, atol_km: float, atol_km_s: float) -> float:  # noqa: PLR0917
    five = three = 0.0
    for i in range(6):
        e5 = e3 = 0.0
        for j in range(_STAGES + 1):
            e5 += _E5[j] * k[j, i]
            e3 += _E3[j] * k[j, i]
        scale = (atol_km if i < 3 else atol_km_s) + rtol * max(abs(y[i]), abs(y_new[i]))
        five += (e5 / scale) ** 2
        three += (e3 / scale) ** 2
    if five == 0.0 and three == 0.0:
        return 0.0
    return abs(h) * five / sqrt((five + 0.01 * three) * 6.0)


@kernel()
def _polynomial(h: float, y: Floats, y_new: Floats, k: Floats, out: Floats) -> None:
    for i in range(6):
        delta = y_new[i] - y[i]
        out[0, i] = delta
        out[1, i] = h * k[0, i] - delta
        out[2, i] = 2.0 * delta - h * (k[12, i] + k[0, i])
        for p in range(4):
            total = 0.0
            for j in range(16):
                total += _D[p, j] * k[j, i]
            out[3 + p, i] = h * total


@kernel()
def integrate(  # noqa: PLR0917
    t0_s: float,
    y0: Floats,
    first_step_s: float,
    until_s: float,
    rtol: float,
    atol_km: float,
    atol_km_s: float,
    max_steps: int,
    tables: ForceTables,
    model: ForceModel,
) -> tuple[int, Floats, Floats, Floats, float, int]:
    """Return the steps from ``t0_s`` past ``until_s``: count, times, states, polynomials, next step, status.

    Notes
    -----
    Dormand-Prince 8(5,3) with the error norm of Hairer (DOP853). The last step is not cut to end at ``until_s``, so
    that a longer integration repeats a shorter one bit by bit.
    """
    order = model.c.shape[0] - 1 + 3
    work = np.zeros((3, order, order))
    k = np.zeros((16, 6))
    at = np.empty(6)
    size = 256
    t, y, poly = np.empty(size + 1), np.empty((size + 1, 6)), np.empty((size, 7, 6))
    t[0] = t0_s
    y[0] = y0
    n, h, direction = 0, first_step_s, np.sign(first_step_s)
    status = DONE
    acceleration(t0_s, y0, tables, model, work, k[0])
    is_after_rejection = False
    while (until_s - t[n]) * direction > 0.0:
        if n == max_steps:
            status = TOO_MANY_STEPS
            break
        if n == size:
            t, y, poly = _grown(t, y, poly, size)
            size *= 2
        for s in range(1, _STAGES + 1):
            _stage(s, t[n], h, y[n], k, tables, model, work, at)
        error = _error_norm(h, k, y[n], at, rtol, atol_km, atol_km_s)
        if not error < 1.0:
            h *= max(_SHRINK, _SAFETY * error ** (-0.125)) if error < np.inf else _SHRINK
            is_after_rejection = True
            if abs(h) < _SMALLEST_STEP_S:
                status = STEP_TOO_SMALL
                break
            continue
        y[n + 1] = at
        t[n + 1] = t[n] + h
        for s in range(13, 16):
            _stage(s, t[n], h, y[n], k, tables, model, work, at)
        _polynomial(h, y[n], y[n + 1], k, poly[n])
        k[0] = k[12]
        n += 1
        if y[n, 0] ** 2 + y[n, 1] ** 2 + y[n, 2] ** 2 < model.radius_km**2:
            status = BELOW_SURFACE
            break
        growth = _GROW if error == 0.0 else min(_GROW, _SAFETY * error ** (-0.125))
        if is_after_rejection:
            growth = min(1.0, growth)
        is_after_rejection = False
        h = direction * min(abs(h * growth), NODE_S)
    return n, t, y, poly, h, status


@kernel()
def _grown(t: Floats, y: Floats, poly: Floats, size: int) -> tuple[Floats, Floats, Floats]:
    t2, y2, poly2 = np.empty(2 * size + 1), np.empty((2 * size + 1, 6)), np.empty((2 * size, 7, 6))
    t2[: size + 1], y2[: size + 1], poly2[:size] = t, y, poly
    return t2, y2, poly2


@kernel()
def evaluate(at_s: Floats, t: Floats, y: Floats, poly: Floats) -> Floats:
    """Return the states at ``at_s``, shape (n,), inside the steps: shape (n, 6), km and km/s."""
    out = np.empty((at_s.shape[0], 6))
    last = poly.shape[0] - 1
    direction = 1.0 if t[last + 1] >= t[0] else -1.0
    step = 0
    for k in range(at_s.shape[0]):
        if not (step <= last and (at_s[k] - t[step]) * direction >= 0.0 >= (at_s[k] - t[step + 1]) * direction):
            low, high = 0, last
            while low < high:
                middle = (low + high) // 2
                if (at_s[k] - t[middle + 1]) * direction > 0.0:
                    low = middle + 1
                else:
                    high = middle
            step = low
        x = (at_s[k] - t[step]) / (t[step + 1] - t[step])
        for i in range(6):
            value = 0.0
            for p in range(6, -1, -1):
                value = (value + poly[step, p, i]) * (x if p % 2 == 0 else 1.0 - x)
            out[k, i] = y[step, i] + value
    return out
