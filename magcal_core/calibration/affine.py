"""Affine least squares y = A x + c with honest errors: what mounting and comparisons of sensors are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import BlockScores, block_moments, block_starts
from magcal_core.calibration.uncertainty import honest_covariance
from magcal_core.calibration.weights import robust_sigma, weights_and_slopes

Floats = NDArray[np.float64]

_ROUNDS: Final = 6
_BLOCKS: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """The affine map and its honest covariance.

    Attributes
    ----------
    matrix, offset : shape (3, 3), (3,)
        A and c.
    covariance : shape (12, 12)
        Of (A row by row, each row followed by its element of c).
    residuals : shape (n, 3)
        y - A x - c.
    weights : shape (n,)
        Prior times robust weights.
    """

    matrix: Floats
    offset: Floats
    covariance: Floats
    residuals: Floats
    weights: Floats

    def matrix_covariance(self, derivative: Floats) -> Floats:
        """Return the covariance of figures whose ``derivative`` by A is of shape (m, 3, 3)."""
        at = np.array([4 * i + j for i in range(3) for j in range(3)])
        flat = derivative.reshape(len(derivative), 9)
        return np.asarray(flat @ self.covariance[np.ix_(at, at)] @ flat.T)

    @property
    def offset_covariance(self) -> Floats:
        """Covariance of c, shape (3, 3)."""
        return self.covariance[3::4, 3::4]


def fit_affine(x: Floats, y: Floats, weights: Floats, *, is_robust: bool) -> Affine:
    """Return the weighted least-squares map from ``x`` to ``y``, each of shape (n, 3), under Huber's loss if asked.

    The rows share their weights, and scores of all twelve unknowns are summed block by block.
    """
    total, floor = weights, 1e-12 * float(np.abs(y).max())
    for _ in range(_ROUNDS if is_robust else 1):
        matrix, offset = _solve(x, y, total)
        residuals = y - x @ matrix.T - offset
        if is_robust:
            worst = np.linalg.norm(residuals, axis=1)
            sigma = robust_sigma(worst[weights > 0], floor) / np.sqrt(3.0)
            total = weights * weights_and_slopes(worst / np.sqrt(3.0), "huber", sigma)[0]
    return Affine(matrix, offset, _covariance(x, residuals, total), residuals, total)


def _solve(x: Floats, y: Floats, weights: Floats) -> tuple[Floats, Floats]:
    share = weights / weights.sum()
    x_middle, y_middle = share @ x, share @ y
    left = (x - x_middle) * np.sqrt(share)[:, None]
    right = (y - y_middle) * np.sqrt(share)[:, None]
    matrix = np.linalg.lstsq(left, right, rcond=None)[0].T
    return matrix, y_middle - matrix @ x_middle


def _covariance(x: Floats, residuals: Floats, weights: Floats) -> Floats:
    n = len(x)
    # Scaled so that the normal matrix is near unity: x is in nT, the constant is 1.
    scale = np.array([*np.sqrt(np.mean(x**2, axis=0)), 1.0])
    design = np.column_stack([x, np.ones(n)]) / scale
    starts = block_starts(n, _BLOCKS)
    weighted = design * weights[:, None]
    moments, errors = block_moments(weighted, design, starts), block_moments(weighted, residuals, starts)
    normals = np.zeros((len(starts), 12, 12))
    for axis in range(3):
        at = slice(4 * axis, 4 * axis + 4)
        normals[:, at, at] = moments
    scores = np.concatenate([errors[:, :, axis] for axis in range(3)], axis=1)
    own = np.diag(np.tile(1.0 / scale, 3))
    inverse = np.linalg.inv(moments.sum(axis=0))
    dof = max(float(np.count_nonzero(weights > 0)) - 4.0, 1.0)
    variances = np.sum(weights[:, None] * residuals**2, axis=0) / dof
    formal = own @ np.kron(np.diag(variances), inverse) @ own
    return honest_covariance(BlockScores(scores, normals, starts, own), formal, n).covariance
