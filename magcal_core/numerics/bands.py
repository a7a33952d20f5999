"""Positive definite band matrices, by their lower diagonals: the Cholesky factor, and what it solves.

Notes
-----
Row d of a band, shape (w, n), has the elements A[j + d, j] at j; what stands beyond the matrix is not read. They are
LAPACK's ``pbtrf`` and ``pbtrs`` with ``lower``: bands of four diagonals gain nothing by its blocks, and `scipy.linalg`
takes a fifth of a second to import.
"""

from __future__ import annotations

import math

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel


def band_factor(band: Floats) -> Floats:
    """Return the lower Cholesky factor of a positive definite band matrix, both shape (w, n).

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.
    """
    factor = np.array(band, dtype=np.float64, order="C")
    if not _factorise(factor):
        raise np.linalg.LinAlgError("the band matrix is not positive definite")
    return factor


def band_solution(factor: Floats, right: Floats) -> Floats:
    """Return A^-1 ``right``, both shape (n, k), of a matrix with the Cholesky ``factor``, shape (w, n)."""
    found = np.array(right, dtype=np.float64, order="C")
    _solve(factor, found)
    return found


@kernel()
def _factorise(band: Floats) -> bool:  # pragma: no cover - compiled
    """Leave the Cholesky factor of ``band`` in its place; False where a pivot is not positive."""
    width, n = band.shape
    for j in range(n):
        pivot = band[0, j]
        if not pivot > 0.0:
            return False
        root = math.sqrt(pivot)
        band[0, j] = root
        reach = min(width, n - j)
        for d in range(1, reach):
            band[d, j] /= root
        for d in range(1, reach):
            below = band[d, j]
            for e in range(d, reach):
                band[e - d, j + d] -= band[e, j] * below
    return True


@kernel()
def _solve(factor: Floats, right: Floats) -> None:  # pragma: no cover - compiled
    """Leave A^-1 ``right`` in its place."""
    width, n = factor.shape
    k = right.shape[1]
    for i in range(n):
        for d in range(1, min(width, i + 1)):
            share = factor[d, i - d]
            for c in range(k):
                right[i, c] -= share * right[i - d, c]
        for c in range(k):
            right[i, c] /= factor[0, i]
    for i in range(n - 1, -1, -1):
        for d in range(1, min(width, n - i)):
            share = factor[d, i]
            for c in range(k):
                right[i, c] -= share * right[i + d, c]
        for c in range(k):
            right[i, c] /= factor[0, i]
