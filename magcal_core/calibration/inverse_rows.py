"""Rows of B = S (h - b) by weighted linear least squares: B_i on (B_1..B_i-1, h_i, 1), the Lagrange paper's problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.weights import robust_sigma, weights_and_slopes

Floats = NDArray[np.float64]

_ROUNDS: Final = 100


@dataclass(frozen=True, slots=True, eq=False)
class InverseRows:
    """Three regressions of the field on the reading.

    Attributes
    ----------
    h_nt, b_nt : shape (n, 3)
    gains : shape (3,)
        p_i: p1 = gamma1, p2 = beta1 gamma2, p3 = beta2 beta3 gamma3.
    below : shape (3, 3)
        Coefficients of B_j in row i with the paper's signs turned: alpha1, s = alpha2 beta3, alpha3.
    intercepts_nt : shape (3,)
        q_i = -p_i b_i.
    residuals_nt : shape (n, 3)
        B - regression, nT.
    """

    h_nt: Floats
    b_nt: Floats
    gains: Floats
    below: Floats
    intercepts_nt: Floats
    residuals_nt: Floats
    sigma_nt: Floats
    weights: Floats
    softening: float = 1.0
    rounds: int = 1
    is_converged: bool = True

    @property
    def matrix(self) -> Floats:
        """T, lower triangular: row i is (coefficients below, 1) / p_i."""
        return np.asarray((self.below + np.eye(3)) / self.gains[:, None])

    @property
    def bias_nt(self) -> Floats:
        """Zero offset b_i = -q_i / p_i, nT."""
        return np.asarray(-self.intercepts_nt / self.gains)

    def design(self, axis: int) -> Floats:
        """Return the regressors of one row, shape (n, axis + 2): (B_1..B_i-1, h_i, 1), signs of `below` turned."""
        return np.column_stack([-self.b_nt[:, :axis], self.h_nt[:, axis], np.ones(len(self.h_nt))])

    def stationarity(self, axis: int, errors: Floats) -> float:
        """Return the largest |regressor^T error| of one row, each over the lengths of regressor and field component."""
        design = self.design(axis)
        root = np.sqrt(self.weights)
        size = np.linalg.norm(design * root[:, None], axis=0) * np.linalg.norm(self.b_nt[:, axis] * root)
        return float(np.max(np.abs(design.T @ (self.weights * errors)) / size))

    def jacobian(self) -> Floats:
        """Return d(T11..T33, b)/d(unknowns), shape (9, 9); unknowns by row: (below, p, q) of rows 1, 2, 3."""
        jacobian = np.zeros((9, 9))
        for axis in range(3):
            first, row, p = (0, 2, 5)[axis], (0, 1, 3)[axis], self.gains[axis]
            at_p, at_q = first + axis, first + axis + 1
            for j in range(axis):
                jacobian[row + j, first + j] = 1.0 / p
                jacobian[row + j, at_p] = -self.below[axis, j] / p**2
            jacobian[row + axis, at_p] = -1.0 / p**2
            jacobian[6 + axis, at_p] = self.intercepts_nt[axis] / p**2
            jacobian[6 + axis, at_q] = -1.0 / p
        return jacobian


def fit_inverse_rows(h_nt: Floats, b_nt: Floats, weights: Floats, noise_nt: Floats | None = None) -> InverseRows:
    """Return the weighted regressions by centred QR.

    ``noise_nt``, shape (3,): noise of the readings, nT; where given, its square is taken from the readings' variance,
    which removes the attenuation that noise in a regressor causes.
    """
    count, total = int(np.count_nonzero(weights > 0)), float(weights.sum())
    root = np.sqrt(weights)
    gains, below, intercepts = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    errors, sigma = np.zeros_like(b_nt), np.zeros(3)
    for axis in range(3):
        raw = np.column_stack([b_nt[:, :axis], h_nt[:, axis]])
        centre, middle = weights @ raw / total, float(weights @ b_nt[:, axis] / total)
        spread = np.maximum(np.sqrt(weights @ (raw - centre) ** 2 / total), 1e-300)
        columns, target = (raw - centre) / spread * root[:, None], (b_nt[:, axis] - middle) * root
        if noise_nt is None:
            q, r = np.linalg.qr(columns)
            solution = np.linalg.solve(r, q.T @ target) / spread
        else:
            moments = columns.T @ columns
            moments[-1, -1] -= total * (noise_nt[axis] / spread[-1]) ** 2
            solution = np.linalg.solve(moments, columns.T @ target) / spread
        gains[axis], below[axis, :axis] = solution[-1], -solution[:-1]
        intercepts[axis] = middle - centre @ solution
        errors[:, axis] = (b_nt[:, axis] - middle) - (raw - centre) @ solution
        noise = float(np.sum(weights * errors[:, axis] ** 2)) / max(count - axis - 2, 1)
        sigma[axis] = max(np.sqrt(noise), 1e-13 * float(np.abs(b_nt[:, axis]).max()), 1e-300)
    return InverseRows(h_nt, b_nt, gains, below, intercepts, errors, sigma, weights)


def reweighted_inverse(h_nt: Floats, b_nt: Floats, prior: Floats, robust: str) -> InverseRows:
    """Return the regressions under a robust loss; the worst of a sample's three residuals decides its weight."""
    rows = fit_inverse_rows(h_nt, b_nt, prior)
    if robust == "none":
        return rows
    used, floor = prior > 0, 1e-12 * float(np.abs(b_nt).max())
    for name in dict.fromkeys(("soft_l1", robust)):
        rounds, is_converged, previous = 0, False, rows
        while rounds < _ROUNDS and not is_converged:
            scales = [robust_sigma(rows.residuals_nt[used, axis], floor) for axis in range(3)]
            weight, slope = weights_and_slopes(np.abs(rows.residuals_nt / scales).max(axis=1), name, 1.0)
            rows = fit_inverse_rows(h_nt, b_nt, prior * weight)
            moved = np.abs(rows.residuals_nt - previous.residuals_nt).max()
            is_converged = bool(moved <= 1e-9 * rows.sigma_nt.max())
            previous, rounds = rows, rounds + 1
    share = float(np.sum(prior * weight) / max(np.sum(prior * slope), 0.05 * np.sum(prior)))
    psi = float(np.sum(prior[:, None] * (weight[:, None] * rows.residuals_nt) ** 2))
    plain = float(np.sum((prior * weight)[:, None] * rows.residuals_nt**2))
    mean_weight = float(np.sum(prior * weight) / np.sum(prior))
    softening = share**2 / mean_weight * psi / max(plain, 1e-300)
    return replace(rows, softening=softening, rounds=rounds, is_converged=is_converged)
