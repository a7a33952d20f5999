"""Sums of weighted products of columns, compiled."""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel

FAST: Final = {"reassoc", "contract", "nsz"}


@kernel(fastmath=FAST, error_model="numpy")
def add_products(rows: Floats, count: int, total: Floats) -> None:  # pragma: no cover - compiled
    """Add rows rows^T over ``count`` samples, its upper half in blocks of two by two, to ``total``; even many rows."""
    for c in range(0, rows.shape[0], 2):
        left, right = rows[c], rows[c + 1]
        for d in range(c, rows.shape[0], 2):
            upper, lower = rows[d], rows[d + 1]
            t00, t01, t10, t11 = 0.0, 0.0, 0.0, 0.0
            for i in range(count):
                t00 += left[i] * upper[i]
                t01 += left[i] * lower[i]
                t10 += right[i] * upper[i]
                t11 += right[i] * lower[i]
            total[c, d] += t00
            total[c, d + 1] += t01
            total[c + 1, d] += t10
            total[c + 1, d + 1] += t11


def products_of(rows: Floats) -> Floats:
    """Return rows rows^T, shape (c, c), of an even number of C-contiguous rows, shape (c, n), on one core."""
    total = np.zeros((len(rows), len(rows)))
    add_products(rows, rows.shape[1], total)
    upper = np.triu(total)
    return upper + np.triu(upper, 1).T
