"""Readings to field, and lengths of vectors, in one pass: what residuals, tables and figures are made of."""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _correct(h: Floats, bias: Floats, lower: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(h.shape[0]):
        d1, d2, d3 = h[i, 0] - bias[0], h[i, 1] - bias[1], h[i, 2] - bias[2]
        out[i, 0] = lower[0, 0] * d1
        out[i, 1] = lower[1, 0] * d1 + lower[1, 1] * d2
        out[i, 2] = lower[2, 0] * d1 + lower[2, 1] * d2 + lower[2, 2] * d3


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _lengths(vectors: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(vectors.shape[0]):
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        out[i] = math.sqrt(x * x + y * y + z * z)


def correct(h_nt: Floats, bias_nt: Floats, lower: Floats) -> Floats:
    """Return ``lower`` (h - b), shape (n, 3), nT; ``lower``: T^-1, lower triangular."""
    out = np.empty(h_nt.shape)
    _correct(np.require(h_nt, np.float64, ["C", "W"]), np.require(bias_nt, np.float64, ["C", "W"]), lower, out)
    return out


def lengths(vectors: Floats) -> Floats:
    """Return the lengths, shape (n,), of vectors of shape (n, 3), in their unit."""
    out = np.empty(len(vectors))
    _lengths(np.require(vectors, np.float64, ["C", "W"]), out)
    return out
