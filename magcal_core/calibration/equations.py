"""Normal equations at given parameters, in the reported parameters themselves: no search, no start."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import BlockScores, Observations, block_starts
from magcal_core.calibration.jacobians import (
    Standardised,
    rows_from_theta,
    rows_jacobian,
    theta_jacobian,
    theta_of_parameters,
)
from magcal_core.calibration.kernels import accumulate
from magcal_core.calibration.result import Parameters
from magcal_core.sensor import matrix_of_parameters

Floats = NDArray[np.float64]

_PLAIN = -1.0


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Sums over samples at fixed parameters, in the order of `Parameters.names` without the clock.

    Attributes
    ----------
    normal : shape (p, p)
        Sum of J^T W J.
    gradient : shape (p,)
        Sum of J^T W r, r the residual, nT, and J its derivative.
    cost : float
        Sum of W r^2, nT^2.
    """

    normal: Floats
    gradient: Floats
    cost: float


def equations_at(observations: Observations, parameters: Parameters, *, is_vector: bool) -> Equations:
    """Return the normal equations of ``observations`` at ``parameters``.

    The residual is |T^-1 (h - b)| - |B|, or h - T B - b along the sensor's axes where ``is_vector``.
    """
    return _of_vector(observations, parameters) if is_vector else _of_scalar(observations, parameters)


def block_equations(
    observations: Observations, parameters: Parameters, *, is_vector: bool, blocks: int = 256
) -> tuple[Equations, BlockScores]:
    """Return the normal equations and the same in short consecutive blocks, for honest errors."""
    n = len(observations)
    starts = block_starts(n, blocks)
    parts = [
        equations_at(observations.take(slice(i, j)), parameters, is_vector=is_vector)
        for i, j in itertools.pairwise([*starts.tolist(), n])
    ]
    normals = np.stack([part.normal for part in parts])
    scores = np.stack([part.gradient for part in parts])
    whole = Equations(normals.sum(axis=0), scores.sum(axis=0), float(sum(part.cost for part in parts)))
    return whole, BlockScores(scores, normals, starts, np.eye(scores.shape[1]))


def _raw(observations: Observations) -> Standardised:
    """Return the regressors as they are, in the form that the kernels' helpers take."""
    names = tuple(observations.regressors)
    columns = [observations.regressors[name] for name in names]
    stacked = np.column_stack(columns) if columns else np.zeros((len(observations), 0))
    return Standardised(names, np.ascontiguousarray(stacked), np.zeros(len(names)), np.ones(len(names)))


def _of_scalar(o: Observations, parameters: Parameters) -> Equations:
    z = _raw(o)
    theta = theta_of_parameters(parameters, z)
    p = theta.size
    normal, gradient = np.empty((p, p)), np.empty(p)
    no_rates = np.zeros((len(o), 0))
    cost = accumulate(o.h_nt, o.b_nt, o.weights, z.columns, no_rates, theta, 0, 1.0, _PLAIN, normal, gradient)
    matrix, _, _ = rows_from_theta(theta, len(z.names))
    back = np.linalg.inv(rows_jacobian(matrix, z) @ theta_jacobian(theta, len(z.names)))
    return Equations(back.T @ normal @ back, back.T @ gradient, float(cost))


def _of_vector(o: Observations, parameters: Parameters) -> Equations:
    z, b_nt = _raw(o), o.require_vector()
    k = len(z.names)
    p = 9 + 3 * k
    matrix = matrix_of_parameters(parameters.scale, np.deg2rad(parameters.nonorthogonality_deg))
    model = b_nt @ matrix.T + parameters.bias_nt
    for name, slope in parameters.regressors.items():
        model = model + o.regressors[name][:, None] * slope
    residual = o.h_nt - model
    shared = np.column_stack([b_nt, np.ones(len(o)), z.columns])
    weighted = shared * o.weights[:, None]
    moments, errors = weighted.T @ shared, weighted.T @ residual
    normal, gradient = np.zeros((p, p)), np.zeros(p)
    for axis in range(3):
        take = [*range(axis + 1), 3, *range(4, 4 + k)]
        first = (0, 1, 3)[axis]
        at = [*range(first, first + axis + 1), 6 + axis, *(9 + 3 * j + axis for j in range(k))]
        normal[np.ix_(at, at)] = moments[np.ix_(take, take)]
        gradient[at] = -errors[take, axis]
    back = np.linalg.inv(rows_jacobian(matrix, z))
    cost = float(np.sum(o.weights[:, None] * residual**2))
    return Equations(back.T @ normal @ back, back.T @ gradient, cost)
