"""Where the scalar fit begins: closed-form solutions that need no guess, the one of lowest cost is taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magcal_core.sensor import inverse_lower

Floats = NDArray[np.float64]

_ROWS = 65536


def closed_form_starts(h_nt: Floats, b_nt: Floats, weights: Floats) -> list[Floats]:
    """Return starts (L11, L21, L22, L31, L32, L33, c1, c2, c3), c in nT, each from another closed form.

    ``h_nt``: readings, shape (n, 3), nT; ``b_nt``: field magnitudes, shape (n,), nT; ``weights``: shape (n,).

    Notes
    -----
    1. h^T A h - 2 c^T h + d = B^2, ten unknowns, rows weighted with 1/(2 B) so that the residual is that of |x| - B.
    2. The same without B^2 on the right: the smallest singular vector, rescaled by mean B^2. It serves a constant B,
       where d = B^2 solves 1. exactly.
    3. |h|^2 = 2 b.h + k^2 B^2 - |b|^2 for one scale factor: always there.
    """
    used = weights > 0
    scale_nt = float(np.sqrt(np.mean(np.sum(h_nt[used] ** 2, axis=1)))) or 1.0
    gram = _gram(h_nt / scale_nt, b_nt / scale_nt, weights)
    starts = [_ten_unknowns(gram), _homogeneous(gram), _sphere(h_nt / scale_nt, b_nt / scale_nt, weights)]
    return [np.concatenate([start[:6], start[6:] * scale_nt]) for start in starts if start is not None]


def _gram(h: Floats, b: Floats, weights: Floats) -> Floats:
    """Return the 11 x 11 moments of (six squares of h, -2 h, 1, B^2) / (2 B)."""
    gram = np.zeros((11, 11))
    for start in range(0, len(b), _ROWS):
        part = slice(start, start + _ROWS)
        h1, h2, h3 = h[part].T
        columns = [h1 * h1, h2 * h2, h3 * h3, 2 * h1 * h2, 2 * h1 * h3, 2 * h2 * h3]
        columns += [-2 * h1, -2 * h2, -2 * h3, np.ones_like(h1), b[part] ** 2]
        rows = np.stack(columns) * (np.sqrt(weights[part]) / (2 * b[part]))
        gram += rows @ rows.T
    return gram


def _ten_unknowns(gram: Floats) -> Floats | None:
    left, right = gram[:10, :10], gram[:10, 10]
    size = np.sqrt(np.maximum(np.diag(left), 1e-300))
    solution = np.linalg.lstsq(left / np.outer(size, size), right / size, rcond=1e-14)[0] / size
    return _start_of_quadric(solution, None)


def _homogeneous(gram: Floats) -> Floats | None:
    left = gram[:10, :10]
    size = np.sqrt(np.maximum(np.diag(left), 1e-300))
    vector = np.linalg.eigh(left / np.outer(size, size))[1][:, 0] / size
    # Weighted with 1/(4 B^2): the ratio of two elements of the moments is the mean of B^2.
    mean_square = gram[9, 10] / gram[9, 9]
    return _start_of_quadric(vector * np.sign(vector[:3].sum() or 1.0), mean_square)


def _start_of_quadric(solution: Floats, mean_square: float | None) -> Floats | None:
    """Return the start that a quadric's ten coefficients stand for, None where they are no ellipsoid."""
    a11, a22, a33, a12, a13, a23 = solution[:6]
    a = np.array([[a11, a12, a13], [a12, a22, a23], [a13, a23, a33]])
    if not np.isfinite(solution).all() or np.linalg.eigvalsh(a)[0] <= 1e-12 * max(np.abs(a).max(), 1e-300):
        return None
    bias = np.linalg.solve(a, solution[6:9])
    if mean_square is not None:
        radius_square = float(bias @ a @ bias - solution[9])
        if radius_square <= 0:
            return None
        a = a * (mean_square / radius_square)
    try:
        lower = inverse_lower(np.linalg.cholesky(np.linalg.inv(a)))
    except np.linalg.LinAlgError:
        return None
    return _start(lower, bias)


def _sphere(h: Floats, b: Floats, weights: Floats) -> Floats:
    root = np.sqrt(weights) / (2 * b)
    rows = np.column_stack([2 * h, b**2, -np.ones_like(b)]) * root[:, None]
    solution = np.linalg.lstsq(rows, np.sum(h**2, axis=1) * root, rcond=None)[0]
    bias, square = solution[:3], float(solution[3])
    if not 1e-4 < square < 1e4:
        # B hardly varies: B^2 and the constant cannot be told apart, their difference can.
        constant = float(np.mean(solution[3] * b[weights > 0] ** 2) - solution[4]) + float(bias @ bias)
        square = max(constant, 1e-8) / float(np.mean(b[weights > 0] ** 2))
    return _start(np.eye(3) / np.sqrt(square), bias)


def _start(lower: Floats, bias: Floats) -> Floats:
    rows, columns = np.tril_indices(3)
    return np.concatenate([lower[rows, columns], lower @ bias])
