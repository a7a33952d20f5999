"""Levenberg-Marquardt over the scalar kernel, compiled as one loop; `numerics.levenberg_marquardt` without its calls.

Notes
-----
Steps are Newton's: robust weights psi / r make a linear search of ten and more passes, psi' one of three or four. The
minimum is the same.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.scalar_kernel import accumulate
from magcal_core.numerics.levenberg_marquardt import (
    DAMPING_LIMIT,
    DAMPING_START,
    LEAST_SHRINKING,
    MAX_EVALUATIONS,
    ROUNDING,
    STEP,
    Minimum,
    damped_step,
)


@njit(cache=True, nogil=True)
def _descend(  # noqa: PLR0917
    h: Floats,
    b: Floats,
    weight: Floats,
    z: Floats,
    rate: Floats,
    loss: int,
    bend: float,
    sigma: float,
    floor: float,
    is_newton: bool,
    limit: int,
    theta: Floats,
    normal: Floats,
    gradient: Floats,
) -> tuple[float, int, bool]:  # pragma: no cover - compiled
    """Leave the minimum in ``theta``, its matrix and gradient in the last two; return cost, evaluations, converged."""
    p = theta.size
    trial_normal, trial_gradient = np.empty((p, p)), np.empty(p)
    step, trial = np.empty(p), np.empty(p)
    cost = accumulate(h, b, weight, z, rate, theta, loss, bend, sigma, is_newton, normal, gradient)
    evaluations, damping, before = 1, 0.0, 0.0
    while evaluations < limit and math.isfinite(cost):
        is_regular = damped_step(normal, gradient, damping, step)
        moved = np.inf
        if is_regular:
            square = 0.0
            for i in range(p):
                for j in range(p):
                    square += step[i] * normal[i, j] * step[j]
            moved = math.sqrt(abs(square))
            trial[:] = theta + step
            shrinks = 1.0 if before == 0.0 else min(1.0, max(moved / before, LEAST_SHRINKING))
            if damping == 0.0 and moved * shrinks <= STEP * math.sqrt(cost) + ROUNDING * floor:
                theta[:] = trial
                return cost, evaluations, True
            trial_cost = accumulate(
                h, b, weight, z, rate, trial, loss, bend, sigma, is_newton, trial_normal, trial_gradient
            )
            evaluations += 1
            is_rounding = moved * moved <= ROUNDING * cost + (ROUNDING * floor) ** 2
            if trial_cost <= cost or (is_rounding and trial_cost <= cost * (1 + 1e-10)):
                theta[:], cost = trial, trial_cost
                normal[:, :], gradient[:] = trial_normal, trial_gradient
                before = moved if damping == 0.0 else 0.0
                damping = damping / 10 if damping > 1e-6 else 0.0
                continue
            if moved <= 1e-7 * math.sqrt(cost):
                # The cost is flat to rounding in the only direction left: this is the minimum.
                return cost, evaluations, True
        damping = max(10 * damping, DAMPING_START)
        if damping > DAMPING_LIMIT:
            break
    return cost, evaluations, False


def descend(  # noqa: PLR0917
    h_nt: Floats,
    b_nt: Floats,
    weights: Floats,
    z: Floats,
    rate_nt_s: Floats,
    theta: Floats,
    loss: int,
    bend: float,
    sigma: float,
    floor: float,
    *,
    is_newton: bool = True,
    limit: int = MAX_EVALUATIONS,
) -> Minimum:
    """Return the minimum of the scalar kernel's cost that is reached from ``theta`` within ``limit`` evaluations.

    The arrays are those of `scalar_kernel.accumulate` beside this file; ``floor`` is that of `minimise`.
    """
    p = theta.size
    found, normal, gradient = theta.copy(), np.empty((p, p)), np.empty(p)
    cost, evaluations, is_converged = _descend(
        h_nt, b_nt, weights, z, rate_nt_s, loss, bend, sigma, floor, is_newton, limit, found, normal, gradient
    )
    return Minimum(found, float(cost), normal, gradient, int(evaluations), bool(is_converged))
