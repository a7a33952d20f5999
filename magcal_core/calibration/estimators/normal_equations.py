"""Normal equations at given parameters, in the reported parameters themselves: no search, no start."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.scalar_kernel import accumulate
from magcal_core.errors import OptionError
from magcal_core.numerics.blocks import BlockScores, block_moments, block_starts
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations
from magcal_core.sensor.parameterisation import (
    Standardised,
    rows_from_theta,
    rows_jacobian,
    theta_jacobian,
    theta_of_parameters,
)
from magcal_core.sensor.parameters import Parameters

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

    The residual is |T^-1 (h - b)| - |B|, or T B + b - h along the sensor's axes where ``is_vector``.
    """
    normals, scores, costs = _parts(observations, parameters, np.zeros(1, dtype=np.intp), is_vector=is_vector)
    return Equations(normals[0], scores[0], float(costs[0]))


def scalar_responses(observations: Observations, parameters: Parameters, changes_nt: Floats) -> Floats:
    """Return by how much the scalar estimate moves, shape (p, m), where |B| changes by ``changes_nt``, shape (n, m).

    In the order of `Parameters.names` without the clock: one Gauss-Newton step, I^-1 J^T W c.
    """
    o, z = observations, _raw(observations)
    k, m = len(z.names), changes_nt.shape[1]
    own = theta_of_parameters(parameters, z)
    p = own.size
    theta, normal, gradient = np.concatenate([own, np.zeros(m)]), np.empty((p + m, p + m)), np.empty(p + m)
    arrays = (o.h_nt, o.b_nt, o.weights, z.columns, np.ascontiguousarray(changes_nt))
    accumulate(*arrays, theta, 0, 1.0, _PLAIN, False, normal, gradient)
    matrix, _, _ = rows_from_theta(own, k)
    to_parameters = rows_jacobian(matrix, z) @ theta_jacobian(own, k)
    return np.asarray(to_parameters @ scaled_inverse(normal[:p, :p]) @ normal[:p, p:])


def block_equations(
    observations: Observations, parameters: Parameters, *, is_vector: bool, blocks: int = 256
) -> tuple[Equations, BlockScores]:
    """Return the normal equations and the same in short consecutive blocks, for honest errors."""
    starts = block_starts(len(observations), blocks)
    normals, scores, costs = _parts(observations, parameters, starts, is_vector=is_vector)
    whole = Equations(normals.sum(axis=0), scores.sum(axis=0), float(costs.sum()))
    return whole, BlockScores(scores, normals, starts, np.eye(scores.shape[1]))


def block_sums(
    observations: Observations, parameters: Parameters, starts: NDArray[np.intp], *, is_vector: bool
) -> tuple[Floats, Floats]:
    """Return normal matrices, shape (m, p, p), and gradients, shape (m, p), of the blocks that begin at ``starts``."""
    return _parts(observations, parameters, starts, is_vector=is_vector)[:2]


def own_equations(
    observations: Observations, parameters: Parameters, starts: NDArray[np.intp], *, is_vector: bool
) -> tuple[Equations, ...]:
    """Return the normal equations of each block in the fit's own unknowns: all that a cost needs."""
    normals, scores, costs, _ = (_of_vector if is_vector else _of_scalar)(observations, parameters, starts)
    return tuple(Equations(normals[i], scores[i], float(costs[i])) for i in range(len(starts)))


def _parts(
    o: Observations, parameters: Parameters, starts: NDArray[np.intp], *, is_vector: bool
) -> tuple[Floats, Floats, Floats]:
    """Return normal matrices, gradients and costs of the blocks that begin at ``starts``."""
    normals, scores, costs, back = (_of_vector if is_vector else _of_scalar)(o, parameters, starts)
    return back.T @ normals @ back, scores @ back, costs


def _raw(observations: Observations) -> Standardised:
    """Return the regressors as they are, in the form that the kernels' helpers take."""
    names = tuple(observations.regressors)
    columns = [observations.regressors[name] for name in names]
    if any(column.ndim != 1 for column in columns):
        raise OptionError("regressors: those of the scale have no normal equations of their own")
    stacked = np.column_stack(columns) if columns else np.zeros((len(observations), 0))
    return Standardised(names, np.ascontiguousarray(stacked), np.zeros(len(names)), np.ones(len(names)))


_Parts = tuple[Floats, Floats, Floats, Floats]


def _of_scalar(o: Observations, parameters: Parameters, starts: NDArray[np.intp]) -> _Parts:
    """Return the sums in the scalar fit's own unknowns, and the derivative of those by the parameters."""
    z = _raw(o)
    k = len(z.names)
    theta = theta_of_parameters(parameters, z)
    p, m = theta.size, len(starts)
    normals, scores, costs = np.empty((m, p, p)), np.empty((m, p)), np.empty(m)
    no_rates = np.zeros((len(o), 0))
    for block, (i, j) in enumerate(itertools.pairwise([*starts.tolist(), len(o)])):
        arrays = (o.h_nt[i:j], o.b_nt[i:j], o.weights[i:j], z.columns[i:j], no_rates[i:j])
        costs[block] = accumulate(*arrays, theta, 0, 1.0, _PLAIN, False, normals[block], scores[block])
    matrix, _, _ = rows_from_theta(theta, k)
    back = np.asarray(np.linalg.inv(rows_jacobian(matrix, z) @ theta_jacobian(theta, k)), np.float64)
    return normals, scores, costs, back


def _of_vector(o: Observations, parameters: Parameters, starts: NDArray[np.intp]) -> _Parts:
    """Return the sums in the elements of T, b and the regressors' slopes, and the derivative of those."""
    z, b_nt = _raw(o), o.require_vector()
    k = len(z.names)
    p, m = 9 + 3 * k, len(starts)
    matrix = parameters.matrix
    residual = b_nt @ matrix.T + parameters.bias_nt - o.h_nt
    for name, slope in parameters.regressors.items():
        residual = residual + o.regressors[name][:, None] * slope
    shared = np.column_stack([b_nt, np.ones(len(o)), z.columns])
    weighted = shared * o.weights[:, None]
    moments, errors = block_moments(weighted, shared, starts), block_moments(weighted, residual, starts)
    normals, scores = np.zeros((m, p, p)), np.zeros((m, p))
    for axis in range(3):
        take = np.array([*range(axis + 1), 3, *range(4, 4 + k)])
        first = (0, 1, 3)[axis]
        at = np.array([*range(first, first + axis + 1), 6 + axis, *(9 + 3 * j + axis for j in range(k))])
        normals[:, at[:, None], at] = moments[:, take[:, None], take]
        scores[:, at] = errors[:, take, axis]
    costs = np.add.reduceat(o.weights * np.sum(residual**2, axis=1), starts)
    return normals, scores, costs, np.asarray(np.linalg.inv(rows_jacobian(matrix, z)), np.float64)
