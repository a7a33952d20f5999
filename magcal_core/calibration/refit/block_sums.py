"""Sums of a fit's equations over blocks of time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.scalar_kernel import accumulate_blocks, residuals
from magcal_core.numerics.regression import block_sums
from magcal_core.observations import Observations
from magcal_core.sensor.correction import readings_without
from magcal_core.sensor.parameterisation import Standardised, theta_of_parameters
from magcal_core.sensor.parameters import Parameters


@dataclass(frozen=True, slots=True, eq=False)
class BlockSums:
    """Sums over blocks, in the fit's own unknowns q: normals (m, q, q), scores (m, q), costs (m,), nT^2, weights (m,).

    The scores are those of the residual's derivative: half the gradient of the cost.
    """

    normals: Floats
    scores: Floats
    costs: Floats
    weights: Floats

    def moved(self, step: Floats) -> BlockSums:
        """Return the sums after the unknowns have moved by ``step``, shape (q,)."""
        along = self.normals @ step
        costs = self.costs + 2.0 * self.scores @ step + along @ step
        return replace(self, scores=self.scores + along, costs=np.maximum(costs, 0.0))

    def together(self, firsts: NDArray[np.intp]) -> BlockSums:
        """Return the sums of neighbours, which begin at the blocks ``firsts``."""
        return BlockSums(
            np.add.reduceat(self.normals, firsts, axis=0),
            np.add.reduceat(self.scores, firsts, axis=0),
            np.add.reduceat(self.costs, firsts),
            np.add.reduceat(self.weights, firsts),
        )


def scalar_sums(
    o: Observations, at: Parameters, z: Standardised, starts: NDArray[np.intp], noise_nt: float
) -> tuple[Floats, BlockSums, float]:
    """Return the unknowns (T^-1, c, slopes, clock), the sums of |T^-1 (h - b)| - |B|, and their unit over the fit's."""
    m = len(starts)
    theta = np.concatenate([theta_of_parameters(at, z), np.zeros(o.rate_nt_s.shape[1])])
    normals, scores, r = np.empty((m, theta.size, theta.size)), np.empty((m, theta.size)), np.empty(len(o))
    arrays = (o.h_nt, o.b_nt, o.weights, z.columns, o.rate_nt_s, theta)
    accumulate_blocks(*arrays, 0, 1.0, noise_nt, starts, normals, scores)
    residuals(o.h_nt, o.b_nt, z.columns, o.rate_nt_s, theta, noise_nt, r)
    costs, weights = np.add.reduceat(o.weights * r**2, starts), np.add.reduceat(o.weights, starts)
    return theta, BlockSums(normals, scores, costs, weights), 1.0


def vector_sums(
    o: Observations, at: Parameters, z: Standardised, starts: NDArray[np.intp]
) -> tuple[Floats, BlockSums, float]:
    """Return the unknowns (T, b, slopes, clock), the sums of T B + b - h, and their unit over the fit's, nT^2.

    Each axis counts by its own noise, as in the fit; here the mean of these weights is one.
    """
    from magcal_core.calibration.estimators.vector import axis_sums

    matrix, b_nt = at.matrix, o.require_vector()
    k, rates = len(z.names), o.rate_base_nt_s
    m = 0 if rates is None else rates.shape[1]
    r = readings_without(o.regressors, o.h_nt, at) - at.bias_nt - b_nt @ matrix.T
    freedom = np.count_nonzero(o.weights > 0) - np.arange(2, 5) - len(at.regressors)
    shares = np.maximum(freedom, 1) / np.maximum(o.weights @ r**2, 1e-24 * float(o.weights @ o.b_nt**2))
    unit = 1.0 / float(shares.mean())
    shares *= unit
    columns = [b_nt.T, z.columns.T, *([] if rates is None else [rates.reshape(len(o), 3 * m).T])]
    moments = block_sums(np.concatenate(columns), np.ascontiguousarray(r.T), o.weights, starts)
    scores, normals = axis_sums(moments, matrix, shares, k, m)
    slopes = [np.asarray(at.regressors.get(name, np.zeros(3))) for name in z.names]
    bias_nt = at.bias_nt + sum((mean * slope for mean, slope in zip(z.mean, slopes, strict=True)), np.zeros(3))
    scaled = [slope * spread for slope, spread in zip(slopes, z.spread, strict=True)]
    own = np.concatenate([matrix[np.tril_indices(3)], bias_nt, *scaled, np.zeros(m)])
    costs, weights = np.add.reduceat((r**2 @ shares) * o.weights, starts), 3.0 * np.add.reduceat(o.weights, starts)
    return own, BlockSums(normals, -scores, costs, weights), unit
