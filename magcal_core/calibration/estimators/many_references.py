"""How well many references explain readings that may be bad in part: a cheap score, of all of them at once."""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.robust_start import Quadric

_ROUNDS: Final = 3
_RIDGE: Final = 1e-10
_GAUSSIAN_MAD: Final = 1.4826


def median_residuals(quadric: Quadric, fields_nt: Floats) -> Floats:
    """Return the median residual, a share of |B|, that each of many references leaves, shape (c,).

    ``fields_nt``: |B| of each at the rows of the quadric, shape (c, m), nT.

    Notes
    -----
    All ten unknowns of the quadric at once for every reference, three rounds reweighted with 1 / (1 + (r/s)^2):
    cheap, and wrong rows lose their weight where the reference is right.
    """
    rows = quadric.squares
    products = (rows[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
    b = fields_nt / quadric.unit_nt
    base = 1.0 / (2.0 * b) ** 2
    weights, residual = base.copy(), np.empty_like(b)
    size = rows.shape[1]
    ridge = _RIDGE * np.eye(size)
    for _ in range(_ROUNDS):
        normals = (weights @ products).reshape(-1, size, size)
        scale = np.sqrt(np.einsum("cii->ci", normals))
        scaled = normals / (scale[:, :, None] * scale[:, None, :]) + ridge
        right = ((weights * b * b) @ rows) / scale
        found = np.linalg.solve(scaled, right[:, :, None])[:, :, 0] / scale
        residual = np.abs(found @ rows.T - b * b) / (2.0 * b)
        middle = np.maximum(np.median(residual, axis=1), 1e-12)
        weights = base / (1.0 + (residual / (_GAUSSIAN_MAD * middle[:, None])) ** 2)
    return np.asarray(np.median(residual, axis=1) / np.median(b, axis=1))
