"""Levenberg-Marquardt over the scalar kernel's normal matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MAX_EVALUATIONS: Final = 200
_STEP: Final = 1e-9
"""Stop when a step moves the residual vector by less than this share of its length: 1e-9 sqrt(n) standard errors."""
_ROUNDING: Final = 1e-13
_DAMPING_START: Final = 1e-3
_DAMPING_LIMIT: Final = 1e12

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
    evaluations, damping, is_converged = 1, 0.0, False
    while evaluations < limit and np.isfinite(cost):
        step = _damped_step(normal, gradient, damping)
        moved = np.inf if step is None else float(np.sqrt(abs(step @ normal @ step)))
        if step is not None and damping == 0.0 and moved <= _STEP * np.sqrt(cost) + _ROUNDING * floor:
            theta, is_converged = theta + step, True
            break
        if step is not None:
            trial = theta + step
            trial_cost = evaluate(trial, trial_normal, trial_gradient)
            evaluations += 1
            is_rounding = moved**2 <= _ROUNDING * cost + (_ROUNDING * floor) ** 2
            if trial_cost <= cost or (is_rounding and trial_cost <= cost * (1 + 1e-10)):
                theta, cost = trial, trial_cost
                normal, trial_normal = trial_normal, normal
                gradient, trial_gradient = trial_gradient, gradient
                damping = damping / 10 if damping > 1e-6 else 0.0
                continue
            if moved <= 1e-7 * np.sqrt(cost):
                # The cost is flat to rounding in the only direction left: this is the minimum.
                is_converged = True
                break
        damping = max(10 * damping, _DAMPING_START)
        if damping > _DAMPING_LIMIT:
            break
    return Minimum(theta, cost, normal, gradient, evaluations, is_converged)


def _damped_step(normal: Floats, gradient: Floats, damping: float) -> Floats | None:
    """Return -(N + damping diag N)^-1 gradient, None where the matrix is singular; scaled to a unit diagonal."""
    size = np.sqrt(np.diag(normal))
    if not np.isfinite(size).all() or np.any(size == 0.0):
        return None
    scaled = normal / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] = 1.0 + damping
    try:
        factor = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return None
    if np.diag(factor).min() < 1e-7 and damping == 0.0:
        return None
    step = np.linalg.solve(factor.T, np.linalg.solve(factor, gradient / size))
    return np.asarray(-step / size)
