"""Affine least squares y = A x + c with honest errors: what mounting and comparisons of sensors are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, honest_covariance
from magcal_core.numerics.blocks import BlockScores, block_starts
from magcal_core.numerics.regression import Regression

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


def fit_affine(t_s: Floats, x: Floats, y: Floats, weights: Floats, *, is_robust: bool) -> Affine:
    """Return the weighted least-squares map from ``x`` to ``y``, each of shape (n, 3), under Huber's loss if asked.

    ``t_s``: times, shape (n,), s. The rows share their weights; scores of all twelve unknowns are summed by blocks.
    """
    regression = Regression(x.T, y.T, np.ones((3, 3), dtype=bool), weights)
    if is_robust:
        total = regression.reweigh_whole(weights, _ROUNDS)
    else:
        regression.solve(weights)
        total = weights
    matrix = regression.coefficients[:, :3].copy()
    offset = regression.coefficients[:, 3] - matrix @ regression.centre
    residuals = np.ascontiguousarray(regression.residuals.T)
    return Affine(matrix, offset, _covariance(regression, x, total, covered_s(t_s)), residuals, total)


def _covariance(regression: Regression, x: Floats, weights: Floats, duration_s: float) -> Floats:
    n = len(x)
    # Scaled so that the normal matrix is near unity: x is in nT, the constant is 1.
    scale = np.array([*np.sqrt(np.einsum("ij,ij->j", x, x) / n), 1.0])
    starts = block_starts(n, _BLOCKS)
    sums = regression.blocks(weights, starts)
    moments = sums[:, :4, :4] / np.outer(scale, scale)
    errors = sums[:, :4, 4:7] / scale[:, None]
    normals = np.zeros((len(starts), 12, 12))
    for axis in range(3):
        at = slice(4 * axis, 4 * axis + 4)
        normals[:, at, at] = moments
    scores = np.concatenate([errors[:, :, axis] for axis in range(3)], axis=1)
    own = np.diag(np.tile(1.0 / scale, 3))
    inverse = np.linalg.inv(moments.sum(axis=0))
    dof = max(float(np.count_nonzero(weights > 0)) - 4.0, 1.0)
    variances = weights @ regression.residuals.T**2 / dof
    formal = own @ np.kron(np.diag(variances), inverse) @ own
    return honest_covariance(BlockScores(scores, normals, starts, own), formal, n, duration_s).covariance
