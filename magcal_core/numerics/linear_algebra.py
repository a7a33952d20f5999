"""Positive definite systems: the scaled inverse and the damped solution."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import NotObservableError
from magcal_core.numerics.kernel import kernel

_TINY: Final = 1e-300
"""Diagonal of an unknown that nothing determines, so that nothing is divided by zero."""
LEAST_PIVOT: Final = 1e-11
"""Share of a column's square, beside the others, below which some fifty thousand roundings leave no sure sign."""


def scaled_inverse(normal: Floats) -> Floats:
    """Return the inverse of a normal matrix, taken with a unit diagonal so that units cost no digits.

    Raises
    ------
    NotObservableError
        The matrix is singular.
    """
    size = np.sqrt(np.diag(normal))
    try:
        inverse = np.linalg.inv(normal / np.outer(size, size))
    except np.linalg.LinAlgError as error:
        raise NotObservableError(
            "the samples do not determine the parameters: their normal matrix is singular"
        ) from error
    return np.asarray(inverse / np.outer(size, size))


def unit_diagonal(normal: Floats) -> tuple[Floats, Floats]:
    """Return a normal matrix scaled to a unit diagonal, and the roots of its diagonal, (p,), that it was divided by."""
    size = np.sqrt(np.maximum(np.diag(normal), _TINY))
    return normal / np.outer(size, size), size


def scaled_solution(normal: Floats, right: Floats) -> Floats:
    """Return N^-1 ``right``, shape (p,) or (p, m), taken with a unit diagonal.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is singular.
    """
    scaled, size = unit_diagonal(normal)
    if right.ndim == 1:
        return np.asarray(np.linalg.solve(scaled, right / size) / size)
    return np.asarray(np.linalg.solve(scaled, right / size[:, None]) / size[:, None])


def scaled_condition(normal: Floats) -> float:
    """Return the condition number of a normal matrix with a unit diagonal."""
    return float(np.linalg.cond(unit_diagonal(normal)[0]))


def floored_inverse(matrix: Floats, floor: float) -> Floats:
    """Return the inverse of a matrix whose eigenvalues, under a unit diagonal, are no smaller than ``floor``."""
    scaled, size = unit_diagonal(matrix)
    values, vectors = np.linalg.eigh(scaled)
    return np.asarray((vectors / np.maximum(values, floor)) @ vectors.T / np.outer(size, size))


def is_positive_definite(normal: Floats) -> bool:
    """Return whether a normal matrix with a unit diagonal has a Cholesky factor with no pivot below `LEAST_PIVOT`."""
    square = np.diag(normal)
    if not (np.isfinite(normal).all() and (square > 0.0).all()):
        return False
    size = np.sqrt(square)
    try:
        factor = np.linalg.cholesky(normal / size[:, None] / size)
    except np.linalg.LinAlgError:
        return False
    return bool(np.diag(factor).min() ** 2 > LEAST_PIVOT)


@kernel()
def solve_positive(  # noqa: PLR0912 - one straight derivation
    matrix: Floats, right: Floats, damping: float, smallest: float, out: Floats
) -> bool:  # pragma: no cover - compiled
    """Leave (N + damping diag N)^-1 ``right`` in ``out``; False where no pivot above ``smallest`` is left.

    ``matrix``: N, shape (p, p), of which the lower half is read. Cholesky of N scaled to a unit diagonal.
    """
    p = right.size
    size, factor = np.empty(p), np.empty((p, p))
    for i in range(p):
        if not matrix[i, i] > 0.0 or not np.isfinite(matrix[i, i]):
            return False
        size[i] = math.sqrt(matrix[i, i])
    for i in range(p):
        for j in range(i + 1):
            total = matrix[i, j] / (size[i] * size[j]) if i != j else 1.0 + damping
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > smallest:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(p):
        total = right[i] / size[i]
        for k in range(i):
            total -= factor[i, k] * out[k]
        out[i] = total / factor[i, i]
    for i in range(p - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, p):
            total -= factor[k, i] * out[k]
        out[i] = total / factor[i, i]
    for i in range(p):
        out[i] /= size[i]
    return True
