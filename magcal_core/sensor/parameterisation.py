"""From an estimator's own unknowns to the reported parameters, and the derivatives that carry covariances there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.sensor.model import inverse_lower, parameters_of_matrix
from magcal_core.sensor.parameters import Parameters

_LOWER_AT = np.tril_indices(3)
_LOWER = tuple(zip(*_LOWER_AT, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Standardised:
    """Regressors with mean zero and standard deviation one, so that the fit stays well scaled.

    Attributes
    ----------
    columns : shape (n, k)
    mean, spread : shape (k,)
        In the regressors' own units.
    """

    names: tuple[str, ...]
    columns: Floats
    mean: Floats
    spread: Floats

    @classmethod
    def of(cls, names: Sequence[str], columns: Sequence[Floats], n: int) -> Standardised:
        """Return ``columns``, each of shape (n,), standardised."""
        raw = np.column_stack(columns) if columns else np.zeros((n, 0))
        mean, spread = (raw.mean(axis=0), raw.std(axis=0)) if columns else (np.zeros(0), np.zeros(0))
        spread = np.where(spread > 0, spread, 1.0)
        return cls(tuple(names), np.ascontiguousarray((raw - mean) / spread), mean, spread)

    @classmethod
    def of_weighed(cls, columns: Mapping[str, Floats], weights: Floats) -> Standardised:
        """Return ``columns`` with mean and deviation of the samples whose ``weights``, shape (n,), are positive.

        A column that is constant over those is zero there: it cannot be told from the bias.
        """
        if not columns:
            return cls.of((), (), len(weights))
        used = weights > 0
        among = cls.of(tuple(columns), [column[used] for column in columns.values()], len(weights))
        raw = np.column_stack(list(columns.values()))
        return cls(among.names, np.ascontiguousarray((raw - among.mean) / among.spread), among.mean, among.spread)


def matrix_jacobian(matrix: Floats) -> Floats:
    """Return d(k1, k2, k3, e1, e2, e3)/d(T11, T21, T22, T31, T32, T33), shape (6, 6), angles in rad.

    Notes
    -----
    d(k2, e1)/d(T21, T22) = [sin e1, cos e1; cos e1/k2, -sin e1/k2]; d(k3, e2, e3)/dT3 = [u; (c2, -s2 s3, -s2 c3)/k3;
    (0, c3, -s3)/(k3 c2)] with u = T3/k3. Negative scale factors included.
    """
    scale, angles = parameters_of_matrix(matrix)
    (s1, s2, s3), (c1, c2, c3) = np.sin(angles), np.cos(angles)
    _, k2, k3 = scale
    jacobian = np.zeros((6, 6))
    jacobian[0, 0] = 1.0
    jacobian[1, 1:3] = s1, c1
    jacobian[3, 1:3] = c1 / k2, -s1 / k2
    jacobian[2, 3:6] = matrix[2] / k3
    jacobian[4, 3:6] = c2 / k3, -s2 * s3 / k3, -s2 * c3 / k3
    jacobian[5, 3:6] = 0.0, c3 / (k3 * c2), -s3 / (k3 * c2)
    return jacobian


def parameters_from_rows(matrix: Floats, bias_nt: Floats, slopes_nt: Floats, z: Standardised) -> Parameters:
    """Return the parameters of T, b and the slopes, shape (k, 3), of standardised regressors."""
    scale, angles_rad = parameters_of_matrix(matrix)
    per_unit = slopes_nt / z.spread[:, None]
    regressors = {name: per_unit[j] for j, name in enumerate(z.names)}
    return Parameters(bias_nt - z.mean @ per_unit, scale, np.rad2deg(angles_rad), None, regressors)


def rows_jacobian(matrix: Floats, z: Standardised) -> Floats:
    """Return the derivative of the reported parameters by (T11 .. T33, b, slopes of standardised regressors).

    Shape (9 + 3 k, 9 + 3 k); angles in deg, regressors per unit of their column.
    """
    k = len(z.names)
    jacobian = np.zeros((9 + 3 * k, 9 + 3 * k))
    inner = matrix_jacobian(matrix)
    inner[3:] = np.rad2deg(inner[3:])
    jacobian[0:3, 6:9] = np.eye(3)
    jacobian[3:9, 0:6] = inner
    for j in range(k):
        block = slice(9 + 3 * j, 12 + 3 * j)
        jacobian[0:3, block] = -np.eye(3) * z.mean[j] / z.spread[j]
        jacobian[block, block] = np.eye(3) / z.spread[j]
    return jacobian


def rows_from_theta(theta: Floats, k: int) -> tuple[Floats, Floats, Floats]:
    """Return T, b and the regressors' slopes, shape (k, 3), from the scalar fit's unknowns (L, c, d)."""
    lower = lower_of_theta(theta)
    matrix = inverse_lower(lower)
    return matrix, matrix @ theta[6:9], theta[9 : 9 + 3 * k].reshape(k, 3) @ matrix.T


def lower_of_theta(theta: Floats) -> Floats:
    """Return L = T^-1, shape (3, 3), from the scalar fit's unknowns."""
    lower = np.zeros((3, 3))
    lower[_LOWER_AT] = theta[:6]
    return lower


def theta_jacobian(theta: Floats, k: int) -> Floats:
    """Return d(T, b, slopes)/d(L, c, d), shape (9 + 3 k, 9 + 3 k): dT = -T dL T, d(T c) = dT c + T dc."""
    matrix, _, _ = rows_from_theta(theta, k)
    offsets = theta[6 : 9 + 3 * k].reshape(k + 1, 3)
    jacobian = np.zeros((9 + 3 * k, 9 + 3 * k))
    for column, (i, j) in enumerate(_LOWER):
        change = -np.outer(matrix[:, i], matrix[j])
        jacobian[0:6, column] = change[_LOWER_AT]
        jacobian[6:, column] = (offsets @ change.T).ravel()
    for block in range(k + 1):
        at = slice(6 + 3 * block, 9 + 3 * block)
        jacobian[at, at] = matrix
    return jacobian


def theta_of_parameters(parameters: Parameters, z: Standardised) -> Floats:
    """Return the scalar fit's unknowns (L, c, d) at ``parameters``; regressors that they do not have start at zero."""
    lower = parameters.correction_matrix
    slopes = [np.asarray(parameters.regressors.get(name, np.zeros(3))) for name in z.names]
    bias = parameters.bias_nt + sum((m * s for m, s in zip(z.mean, slopes, strict=True)), np.zeros(3))
    scaled = [lower @ (s * spread) for s, spread in zip(slopes, z.spread, strict=True)]
    return np.concatenate([lower[_LOWER_AT], lower @ bias, *scaled])
