"""Levenberg-Marquardt over the scalar kernel's normal matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit

from magcal_core.arrays import Floats
from magcal_core.numerics.linear_algebra import solve_positive

MAX_EVALUATIONS: Final = 200
STEP: Final = 1e-9
"""Stop when the next step moves the residual vector by less than this share of it: 1e-9 sqrt(n) standard errors."""
LEAST_SHRINKING: Final = 1e-3
"""Share of a step that the next one is taken for at least, however fast the search converges."""
ROUNDING: Final = 1e-13
_SINGULAR: Final = 1e-14
"""Square of the smallest pivot of the scaled normal matrix that is told from rounding."""
DAMPING_START: Final = 1e-3
DAMPING_LIMIT: Final = 1e12

Evaluate = Callable[[Floats, Floats, Floats], float]
"""(theta, normal, gradient) -> cost; fills J^T W J and J^T W r."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where the search ended: unknowns, cost, normal matrix and gradient there, and how it went."""

    theta: Floats
    cost: float
    normal: Floats
    gradient: Floats
    evaluations: int
    is_converged: bool


def minimise(evaluate: Evaluate, theta: Floats, floor: float, limit: int = MAX_EVALUATIONS) -> Minimum:
    """Return the minimum of a sum of squares that is reached from ``theta``.

    ``floor`` is the length of the vector of observations: what is below its rounding is taken for zero.
    """
    p = theta.size
    normal, gradient = np.empty((p, p)), np.empty(p)
    trial_normal, trial_gradient = np.empty((p, p)), np.empty(p)
    cost = evaluate(theta, normal, gradient)
    evaluations, damping, before, is_converged = 1, 0.0, 0.0, False
    while evaluations < limit and np.isfinite(cost):
        step = np.empty(p)
        is_regular = damped_step(normal, gradient, damping, step)
        moved = float(np.sqrt(abs(step @ normal @ step))) if is_regular else np.inf
        # The step after this one is shorter by what this one is shorter than the one before.
        shrinks = 1.0 if before == 0.0 else min(1.0, max(moved / before, LEAST_SHRINKING))
        if is_regular and damping == 0.0 and moved * shrinks <= STEP * np.sqrt(cost) + ROUNDING * floor:
            theta, is_converged = theta + step, True
            break
        if is_regular:
            trial = theta + step
            trial_cost = evaluate(trial, trial_normal, trial_gradient)
            evaluations += 1
            is_rounding = moved**2 <= ROUNDING * cost + (ROUNDING * floor) ** 2
            if trial_cost <= cost or (is_rounding and trial_cost <= cost * (1 + 1e-10)):
                theta, cost = trial, trial_cost
                normal, trial_normal = trial_normal, normal
                gradient, trial_gradient = trial_gradient, gradient
                before = moved if damping == 0.0 else 0.0
                damping = damping / 10 if damping > 1e-6 else 0.0
                continue
            if moved <= 1e-7 * np.sqrt(cost):
                # The cost is flat to rounding in the only direction left: this is the minimum.
                is_converged = True
                break
        damping = max(10 * damping, DAMPING_START)
        if damping > DAMPING_LIMIT:
            break
    return Minimum(theta, cost, normal, gradient, evaluations, is_converged)


@njit(cache=True, nogil=True)
def damped_step(normal: Floats, gradient: Floats, damping: float, step: Floats) -> bool:  # pragma: no cover - compiled
    """Leave -(N + damping diag N)^-1 gradient in ``step``, shape (p,); False where the matrix is singular."""
    return solve_positive(normal, -gradient, damping, _SINGULAR if damping == 0.0 else 0.0, step)
