"""Levenberg-Marquardt: every decision of the search, and the loop around what a caller evaluates.

A compiled caller, whose cost no Python function may come between, writes the loop of `minimise` around its own cost:
`propose`, `weigh` and `damp_more` decide for both.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel
from magcal_core.numerics.linear_algebra import solve_positive

MAX_EVALUATIONS: Final = 200
STEP: Final = 1e-9
"""Stop when the next step moves the residual vector by less than this share of it: 1e-9 sqrt(n) standard errors."""
LEAST_SHRINKING: Final = 1e-3
"""Share of a step that the next one is taken for at least, however fast the search converges."""
ROUNDING: Final = 1e-13
_SINGULAR: Final = 1e-14
"""Square of the smallest pivot of the scaled normal matrix that is distinguished from rounding."""
DAMPING_START: Final = 1e-3
DAMPING_LIMIT: Final = 1e12
TRY, FOUND, SINGULAR, ACCEPTED, REJECTED = range(5)
"""What `propose` and `weigh` return."""

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


def minimise(
    evaluate: Evaluate, theta: Floats, floor: float, limit: int = MAX_EVALUATIONS, still: float = 0.0
) -> Minimum:
    """Return the minimum of a sum of squares that is reached from ``theta``.

    ``floor`` is the length of the vector of observations: what is below its rounding is taken for zero. ``still``: a
    step that lowers the cost by no more than this share of it is the last one.
    """
    p = theta.size
    normal, gradient = np.empty((p, p)), np.empty(p)
    trial_normal, trial_gradient = np.empty((p, p)), np.empty(p)
    theta, trial, search = theta.astype(np.float64), np.empty(p), np.zeros(3)
    cost, evaluations, is_converged = evaluate(theta, normal, gradient), 1, False
    while evaluations < limit and np.isfinite(cost):
        found = propose(theta, cost, normal, gradient, floor, search, trial)
        if found == FOUND:
            theta, is_converged = trial, True
            break
        if found == TRY:
            trial_cost = evaluate(trial, trial_normal, trial_gradient)
            evaluations += 1
            found = weigh(cost, trial_cost, floor, search)
            if found == FOUND:
                is_converged = True
                break
        if found == ACCEPTED:
            is_converged = still > 0.0 and cost - trial_cost <= still * cost
            theta, trial, cost = trial, theta, trial_cost
            normal, trial_normal = trial_normal, normal
            gradient, trial_gradient = trial_gradient, gradient
            if is_converged:
                break
        elif not damp_more(search):
            break
    return Minimum(theta, cost, normal, gradient, evaluations, is_converged)


@kernel()
def propose(  # noqa: PLR0917
    theta: Floats, cost: float, normal: Floats, gradient: Floats, floor: float, search: Floats, trial: Floats
) -> int:  # pragma: no cover - compiled
    """Leave the next point in ``trial``; return `TRY`, `FOUND` where it is the minimum, or `SINGULAR`.

    ``search``: damping, length of the step before where it was not damped, length of this step; zeros at the beginning.
    """
    p = theta.size
    step = np.empty(p)
    if not damped_step(normal, gradient, search[0], step):
        return SINGULAR
    square = 0.0
    for i in range(p):
        for j in range(p):
            square += step[i] * normal[i, j] * step[j]
    moved = math.sqrt(abs(square))
    for i in range(p):
        trial[i] = theta[i] + step[i]
    search[2] = moved
    # The step after this one is shorter by what this one is shorter than the one before.
    shrinks = 1.0 if search[1] == 0.0 else min(1.0, max(moved / search[1], LEAST_SHRINKING))
    if search[0] == 0.0 and moved * shrinks <= STEP * math.sqrt(cost) + ROUNDING * floor:
        return FOUND
    return TRY


@kernel()
def weigh(cost: float, trial_cost: float, floor: float, search: Floats) -> int:  # pragma: no cover - compiled
    """Return `ACCEPTED` where the trial is no worse, `FOUND` where the point before is the minimum, or `REJECTED`."""
    moved = search[2]
    is_rounding = moved * moved <= ROUNDING * cost + (ROUNDING * floor) ** 2
    if trial_cost <= cost or (is_rounding and trial_cost <= cost * (1 + 1e-10)):
        search[1] = moved if search[0] == 0.0 else 0.0
        search[0] = search[0] / 10 if search[0] > 1e-6 else 0.0
        return ACCEPTED
    # The cost is flat to rounding in the only direction left: this is the minimum.
    return FOUND if moved <= 1e-7 * math.sqrt(cost) else REJECTED


@kernel()
def damp_more(search: Floats) -> bool:  # pragma: no cover - compiled
    """Damp the next step more; False where no damping is left that could help."""
    search[0] = max(10 * search[0], DAMPING_START)
    return bool(search[0] <= DAMPING_LIMIT)


@kernel()
def damped_step(normal: Floats, gradient: Floats, damping: float, step: Floats) -> bool:  # pragma: no cover - compiled
    """Leave -(N + damping diag N)^-1 gradient in ``step``, shape (p,); False where the matrix is singular."""
    downhill = np.empty(gradient.size)
    for i in range(gradient.size):
        downhill[i] = -gradient[i]
    return solve_positive(normal, downhill, damping, _SINGULAR if damping == 0.0 else 0.0, step)
