"""Where the scalar fit begins: closed-form solutions that need no guess, the one of lowest cost is taken."""

from __future__ import annotations

import math

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel
from magcal_core.numerics.linear_algebra import unit_diagonal
from magcal_core.numerics.products import add_products
from magcal_core.sensor.model import inverse_lower

_ROWS = 256
_LOWER = np.tril_indices(3)


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
    squares = np.einsum("ij,ij->i", h_nt, h_nt)
    scale_nt = float(np.sqrt(np.mean(squares if used.all() else squares[used]))) or 1.0
    gram = _gram(h_nt, b_nt, weights, 1.0 / scale_nt)
    starts = [_ten_unknowns(gram), _homogeneous(gram), _sphere(gram)]
    return [np.concatenate([start[:6], start[6:] * scale_nt]) for start in starts if start is not None]


@kernel(error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _gram(h: Floats, b: Floats, weights: Floats, scale: float) -> Floats:  # pragma: no cover - compiled
    """Return the moments of (six squares of h, -2 h, 1, B^2, 0) / (2 B), shape (12, 12), h and B times ``scale``."""
    rows, total = np.zeros((12, _ROWS)), np.zeros((12, 12))
    for start in range(0, b.size, _ROWS):
        count = min(_ROWS, b.size - start)
        for i in range(count):
            size = scale * b[start + i]
            x, y, z = scale * h[start + i, 0], scale * h[start + i, 1], scale * h[start + i, 2]
            root = math.sqrt(weights[start + i]) / (2.0 * size)
            rows[0, i], rows[1, i], rows[2, i] = root * x * x, root * y * y, root * z * z
            rows[3, i], rows[4, i], rows[5, i] = 2.0 * root * x * y, 2.0 * root * x * z, 2.0 * root * y * z
            rows[6, i], rows[7, i], rows[8, i] = -2.0 * root * x, -2.0 * root * y, -2.0 * root * z
            rows[9, i], rows[10, i] = root, root * size * size
        add_products(rows, count, total)
    for i in range(12):
        for j in range(i):
            total[i, j] = total[j, i]
    return total


def _ten_unknowns(gram: Floats) -> Floats | None:
    left, right = gram[:10, :10], gram[:10, 10]
    scaled, size = unit_diagonal(left)
    solution = np.linalg.lstsq(scaled, right / size, rcond=1e-14)[0] / size
    return start_of_quadric(solution, None)


def _homogeneous(gram: Floats) -> Floats | None:
    scaled, size = unit_diagonal(gram[:10, :10])
    vector = np.linalg.eigh(scaled)[1][:, 0] / size
    # Weighted with 1/(4 B^2): the ratio of two elements of the moments is the mean of B^2.
    mean_square = gram[9, 10] / gram[9, 9]
    return start_of_quadric(vector * np.sign(vector[:3].sum() or 1.0), mean_square)


def start_of_quadric(solution: Floats, mean_square: float | None) -> Floats | None:
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


def _sphere(gram: Floats) -> Floats:
    """Return the start with one scale factor: moments of (2 h, B^2, -1) and |h|^2 are combinations of the others."""
    carry = np.zeros((6, len(gram)))
    carry[[0, 1, 2, 4], [6, 7, 8, 9]] = -1.0
    carry[3, 10] = 1.0
    carry[5, :3] = 1.0
    moments = carry @ gram @ carry.T
    scaled, size = unit_diagonal(moments[:5, :5])
    solution = np.linalg.lstsq(scaled, moments[:5, 5] / size, rcond=1e-14)[0] / size
    bias, square = solution[:3], float(solution[3])
    if not 1e-4 < square < 1e4:
        # B hardly varies: B^2 and the constant cannot be told apart, their difference can.
        mean_square = float(gram[9, 10] / gram[9, 9])
        constant = float(solution[3] * mean_square - solution[4]) + float(bias @ bias)
        square = max(constant, 1e-8) / mean_square
    return _start(np.eye(3) / np.sqrt(square), bias)


def _start(lower: Floats, bias: Floats) -> Floats:
    return np.concatenate([lower[_LOWER], lower @ bias])
