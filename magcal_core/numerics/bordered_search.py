"""Levenberg-Marquardt over a bordered block-diagonal normal matrix: the decisions are those of the dense search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.bordered import Bordered
from magcal_core.numerics.levenberg_marquardt import (
    ACCEPTED,
    FOUND,
    LEAST_SHRINKING,
    MAX_EVALUATIONS,
    ROUNDING,
    SINGULAR,
    STEP,
    TRY,
    damp_more,
    weigh,
)


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What one evaluation leaves: the normal matrix, the gradient of shape (q,) and the cost."""

    normal: Bordered
    gradient: Floats
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class BorderedMinimum:
    """Where the search ended, and the sums there."""

    theta: Floats
    sums: Sums
    is_converged: bool


def minimise_bordered(evaluate: Callable[[Floats], Sums], theta: Floats, floor: float) -> BorderedMinimum:
    """Return the minimum of a sum of squares, by the decisions of `levenberg_marquardt.minimise`.

    ``floor`` is the length of the vector of observations: what is below its rounding is taken for zero.
    """
    sums, evaluations, search = evaluate(theta), 1, np.zeros(3)
    while evaluations < MAX_EVALUATIONS and math.isfinite(sums.cost):
        found, trial = _propose(theta, sums, floor, search)
        if found == FOUND:
            return BorderedMinimum(trial, sums, True)
        if found == TRY:
            tried = evaluate(trial)
            evaluations += 1
            found = weigh(sums.cost, tried.cost, floor, search)
            if found == FOUND:
                return BorderedMinimum(theta, sums, True)
        if found == ACCEPTED:
            theta, sums = trial, tried
        elif not damp_more(search):
            break
    return BorderedMinimum(theta, sums, False)


def _propose(theta: Floats, sums: Sums, floor: float, search: Floats) -> tuple[int, Floats]:
    """Return what `levenberg_marquardt.propose` returns, and the next point."""
    step = sums.normal.damped_step(sums.gradient, float(search[0]))
    if step is None:
        return SINGULAR, theta
    search[2] = moved = math.sqrt(abs(sums.normal.quadratic(step)))
    shrinks = 1.0 if search[1] == 0.0 else min(1.0, max(moved / search[1], LEAST_SHRINKING))
    is_last = search[0] == 0.0 and moved * shrinks <= STEP * math.sqrt(sums.cost) + ROUNDING * floor
    return (FOUND if is_last else TRY), theta + step
