"""The scalar kernel under `numerics.levenberg_marquardt`, compiled: its loop with no Python between the evaluations.

Notes
-----
Steps are Newton's: robust weights psi / r make a linear search of ten and more passes, psi' one of three or four. The
minimum is the same.
"""

from __future__ import annotations

import math

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.scalar_kernel import accumulate
from magcal_core.numerics.kernel import copy_into, kernel
from magcal_core.numerics.levenberg_marquardt import (
    ACCEPTED,
    FOUND,
    MAX_EVALUATIONS,
    TRY,
    Minimum,
    damp_more,
    propose,
    weigh,
)


@kernel()
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
    trial, search = np.empty(p), np.zeros(3)
    cost = accumulate(h, b, weight, z, rate, theta, loss, bend, sigma, is_newton, normal, gradient)
    evaluations = 1
    while evaluations < limit and math.isfinite(cost):
        found = propose(theta, cost, normal, gradient, floor, search, trial)
        if found == FOUND:
            copy_into(theta, trial)
            return cost, evaluations, True
        if found == TRY:
            trial_cost = accumulate(
                h, b, weight, z, rate, trial, loss, bend, sigma, is_newton, trial_normal, trial_gradient
            )
            evaluations += 1
            found = weigh(cost, trial_cost, floor, search)
            if found == FOUND:
                return cost, evaluations, True
            if found == ACCEPTED:
                cost = trial_cost
                copy_into(theta, trial)
                copy_into(gradient, trial_gradient)
                for i in range(p):
                    copy_into(normal[i], trial_normal[i])
        if found != ACCEPTED and not damp_more(search):
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
