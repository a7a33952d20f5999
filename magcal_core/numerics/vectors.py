"""Lengths of rows."""

from __future__ import annotations

import math

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _lengths(vectors: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(vectors.shape[0]):
        x, y, z = vectors[i, 0], vectors[i, 1], vectors[i, 2]
        out[i] = math.sqrt(x * x + y * y + z * z)


def lengths(vectors: Floats) -> Floats:
    """Return the lengths, shape (n,), of vectors of shape (n, 3), in their unit."""
    out = np.empty(len(vectors))
    _lengths(np.require(vectors, np.float64, ["C", "W"]), out)
    return out
