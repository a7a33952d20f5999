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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _corrected_lengths(h: Floats, bias: Floats, lower: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(h.shape[0]):
        d1, d2, d3 = h[i, 0] - bias[0], h[i, 1] - bias[1], h[i, 2] - bias[2]
        x = lower[0, 0] * d1
        y = lower[1, 0] * d1 + lower[1, 1] * d2
        z = lower[2, 0] * d1 + lower[2, 1] * d2 + lower[2, 2] * d3
        out[i] = math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def statistics(
    residuals: Floats, b: Floats, weights: Floats
) -> tuple[float, float, float, float]:  # pragma: no cover - compiled
    """Return mean, variance, largest size and largest share of ``b`` of ``residuals``, shape (n, m), that have weight.

    Sums run over parts of 1024 samples, and those over all: their rounding does not grow with the session.
    """
    n, m = residuals.shape
    total, square, largest, share, count = 0.0, 0.0, 0.0, 0.0, 0
    for start in range(0, n, 1024):
        part = 0.0
        for i in range(start, min(n, start + 1024)):
            if weights[i] > 0.0:
                count += 1
                for j in range(m):
                    size = abs(residuals[i, j])
                    part += residuals[i, j]
                    largest = max(largest, size)
                    share = max(share, size / b[i])
        total += part
    count = max(count * m, 1)
    mean = total / count
    for start in range(0, n, 1024):
        part = 0.0
        for i in range(start, min(n, start + 1024)):
            if weights[i] > 0.0:
                for j in range(m):
                    part += (residuals[i, j] - mean) ** 2
        square += part
    return mean, square / count, largest, share


def correct(h_nt: Floats, bias_nt: Floats, lower: Floats) -> Floats:
    """Return ``lower`` (h - b), shape (n, 3), nT; ``lower``: T^-1, lower triangular."""
    out = np.empty(h_nt.shape)
    _correct(np.require(h_nt, np.float64, ["C", "W"]), np.require(bias_nt, np.float64, ["C", "W"]), lower, out)
    return out


def corrected_lengths(h_nt: Floats, bias_nt: Floats, lower: Floats) -> Floats:
    """Return the lengths of ``lower`` (h - b), shape (n,), nT, without keeping the vectors."""
    out = np.empty(len(h_nt))
    h, bias = np.require(h_nt, np.float64, ["C", "W"]), np.require(bias_nt, np.float64, ["C", "W"])
    _corrected_lengths(h, bias, lower, out)
    return out


def lengths(vectors: Floats) -> Floats:
    """Return the lengths, shape (n,), of vectors of shape (n, 3), in their unit."""
    out = np.empty(len(vectors))
    _lengths(np.require(vectors, np.float64, ["C", "W"]), out)
    return out
