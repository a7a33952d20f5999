"""How well the best linear sensor explains readings: closed forms that score wrong inputs in microseconds."""

from __future__ import annotations

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.robust import robust_sigma

_FAR = 6.0
_FLOOR = 1e-7


def residual_floor_nt(b_nt: Floats) -> float:
    """Return the residual below which nothing is believed, nT: 1e-7 of the field ``b_nt``, shape (n,) or (n, 3)."""
    size = np.linalg.norm(b_nt, axis=1) if b_nt.ndim == 2 else b_nt
    return _FLOOR * float(np.mean(size))


def affine_residuals_nt(h_nt: Floats, b_nt: Floats) -> Floats:
    """Return h - (T B + b) of the unconstrained least-squares T, b, shape (n, 3), nT; any mounting is absorbed."""
    b_middle, h_middle = b_nt.mean(axis=0), h_nt.mean(axis=0)
    b, h = b_nt - b_middle, h_nt - h_middle
    gains = np.linalg.lstsq(b.T @ b, b.T @ h, rcond=1e-12)[0]
    return np.asarray(h - b @ gains)


def trimmed(h_nt: Floats, b_nt: Floats) -> tuple[Floats, Floats]:
    """Return the samples that lie within six robust deviations of the best linear sensor, each shape (m, 3)."""
    size = np.linalg.norm(affine_residuals_nt(h_nt, b_nt), axis=1)
    near = size <= _FAR * robust_sigma(size, residual_floor_nt(b_nt))
    return h_nt[near], b_nt[near]


def affine_rms_nt(h_nt: Floats, b_nt: Floats) -> float:
    """Return the root mean square of a component, nT, that the best linear sensor leaves, far samples left out."""
    residuals = affine_residuals_nt(*trimmed(h_nt, b_nt))
    return float(np.hypot(np.sqrt(np.mean(residuals**2)), residual_floor_nt(b_nt)))


def centred_moments(h_nt: Floats, b_nt: Floats) -> tuple[Floats, Floats, Floats]:
    """Return var h_j, shape (3,), cov(B_i, h_j) and cov(B_i, B_j), each of shape (3, 3), nT^2."""
    h, b = h_nt - h_nt.mean(axis=0), b_nt - b_nt.mean(axis=0)
    n = len(h)
    return np.mean(h**2, axis=0), b.T @ h / n, b.T @ b / n


class QuadricScore:
    """Scores of |B| candidates for readings: h^T A h - 2 c^T h + d = B^2, ten unknowns, linear in B^2.

    Notes
    -----
    The rows are weighted with 1/(2 B), so that the residual is that of |x| - B, nT. One orthonormal basis of the
    readings' ten columns serves every candidate.
    """

    __slots__ = ("_basis", "_root")

    def __init__(self, h_nt: Floats, b_nt: Floats) -> None:
        """Prepare for readings of shape (n, 3), nT; ``b_nt``, shape (n,), sets the weights only."""
        scale = float(np.sqrt(np.mean(np.sum(h_nt**2, axis=1))))
        h1, h2, h3 = (h_nt / scale).T
        columns = [h1 * h1, h2 * h2, h3 * h3, h1 * h2, h1 * h3, h2 * h3, h1, h2, h3, np.ones_like(h1)]
        self._root = 1.0 / (2.0 * b_nt)
        self._basis = np.linalg.qr(np.column_stack(columns) * self._root[:, None])[0]

    def residuals_nt(self, candidates_nt: Floats) -> Floats:
        """Return the residuals, shape (n, m), nT, of field magnitudes of shape (n, m), nT."""
        target = candidates_nt**2 * self._root[:, None]
        return np.asarray(target - self._basis @ (self._basis.T @ target))
