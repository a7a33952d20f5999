"""Rows of B = S (h - b) by weighted linear least squares: B_i on (B_1..B_i-1, h_i, 1), the Lagrange paper's problem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.regression import Regression
from magcal_core.numerics.robust import robust_sigma, shared_weight_slope


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


_TAKES: Final = np.array([[0, 0, 1, 0, 0], [1, 0, 0, 1, 0], [1, 1, 0, 0, 1]], dtype=bool)
"""Which of (B1, B2, h1, h2, h3) explain B1, B2 and B3."""


def fit_inverse_rows(h_nt: Floats, b_nt: Floats, weights: Floats, noise_nt: Floats | None = None) -> InverseRows:
    """Return the weighted regressions.

    ``noise_nt``, shape (3,): noise of the readings, nT; where given, its square is taken from the readings' variance,
    which removes the attenuation that noise in a regressor causes.

    Raises
    ------
    NotObservableError
        A reading is a combination of the field's components.
    """
    if noise_nt is not None:
        return _without_attenuation(h_nt, b_nt, weights, noise_nt)
    regression = _regression(h_nt, b_nt, weights)
    regression.solve(weights)
    return _rows(regression, h_nt, b_nt, weights)


def _regression(h_nt: Floats, b_nt: Floats, weights: Floats) -> Regression:
    return Regression(np.concatenate([b_nt[:, :2].T, h_nt.T]), b_nt.T, _TAKES, weights)


def _rows(regression: Regression, h_nt: Floats, b_nt: Floats, weights: Floats) -> InverseRows:
    count, found = int(np.count_nonzero(weights > 0)), regression.coefficients
    below = np.zeros((3, 3))
    below[:, :2] = -found[:, :2]
    intercepts = found[:, -1] - found[:, :-1] @ regression.centre
    freedom = np.maximum(count - np.arange(3) - 2, 1)
    sigma = np.maximum(np.sqrt(regression.squares / freedom), regression.smallest)
    residuals = np.ascontiguousarray(regression.residuals.T)
    return InverseRows(h_nt, b_nt, np.diag(found[:, 2:5]).copy(), below, intercepts, residuals, sigma, weights)


def _without_attenuation(h_nt: Floats, b_nt: Floats, weights: Floats, noise_nt: Floats) -> InverseRows:
    """Return the regressions with the noise of the readings, shape (3,), nT, taken from their variance."""
    count, total = int(np.count_nonzero(weights > 0)), float(weights.sum())
    root = np.sqrt(weights)
    gains, below, intercepts = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    errors, sigma = np.zeros_like(b_nt), np.zeros(3)
    for axis in range(3):
        raw = np.column_stack([b_nt[:, :axis], h_nt[:, axis]])
        centre, middle = weights @ raw / total, float(weights @ b_nt[:, axis] / total)
        spread = np.maximum(np.sqrt(weights @ (raw - centre) ** 2 / total), 1e-300)
        columns, target = (raw - centre) / spread * root[:, None], (b_nt[:, axis] - middle) * root
        moments = columns.T @ columns
        moments[-1, -1] -= total * (noise_nt[axis] / spread[-1]) ** 2
        solution = np.linalg.solve(moments, columns.T @ target) / spread
        gains[axis], below[axis, :axis] = solution[-1], -solution[:-1]
        intercepts[axis] = middle - centre @ solution
        errors[:, axis] = (b_nt[:, axis] - middle) - (raw - centre) @ solution
        noise = float(np.sum(weights * errors[:, axis] ** 2)) / max(count - axis - 2, 1)
        sigma[axis] = max(np.sqrt(noise), 1e-13 * float(np.abs(b_nt[:, axis]).max()), 1e-300)
    return InverseRows(h_nt, b_nt, gains, below, intercepts, errors, sigma, weights)


def reweighted_inverse(
    h_nt: Floats, b_nt: Floats, prior: Floats, robust: str, near: Floats | None = None
) -> InverseRows:
    """Return the regressions under a robust loss; the worst of a sample's three residuals decides its weight.

    ``near``: weights, shape (n,), of the rows that the search begins at; the loss then goes on from there.

    Raises
    ------
    NotObservableError
        A reading is a combination of the field's components.
    """
    first = prior if near is None or robust == "none" else near
    regression = _regression(h_nt, b_nt, first)
    regression.solve(first)
    if robust == "none":
        return _rows(regression, h_nt, b_nt, prior)
    for name in dict.fromkeys(("soft_l1", robust)) if near is None else (robust,):
        weights, rounds, is_converged = regression.reweigh(prior, name)
    rows = _rows(regression, h_nt, b_nt, weights)
    used, floor = prior > 0, 1e-12 * float(np.abs(b_nt).max())
    scales = [robust_sigma(rows.residuals_nt[used, axis], floor) for axis in range(3)]
    weight = np.divide(weights, prior, out=np.zeros_like(prior), where=used)
    total, squares = float(prior.sum()), np.sum(rows.residuals_nt**2, axis=1)
    share = shared_weight_slope(rows.residuals_nt / scales, prior, weight, robust)
    psi, plain = float((weights * weight) @ squares), float(weights @ squares)
    softening = share**2 / (float(weights.sum()) / total) * psi / max(plain, 1e-300)
    return replace(rows, softening=softening, rounds=rounds, is_converged=is_converged)
