"""Blocks of consecutive samples: where they start, and the sums over each."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats


@dataclass(frozen=True, slots=True, eq=False)
class BlockScores:
    """The estimating equations summed over short consecutive blocks: what honest errors are computed from.

    Attributes
    ----------
    scores : shape (m, q)
        Sum of J^T W r over each block, in the estimator's own unknowns.
    normals : shape (m, q, q)
        Sum of J^T W J over each block.
    starts : shape (m,)
        First sample of each block.
    to_parameters : shape (p, q)
        Derivative of the reported parameters by the estimator's own unknowns.
    """

    scores: Floats
    normals: Floats
    starts: NDArray[np.intp]
    to_parameters: Floats


def block_starts(n: int, blocks: int = 256) -> NDArray[np.intp]:
    """Return the first samples of consecutive blocks of ``n`` samples, of nearly equal length.

    About eight samples each, at least 16 and at most ``blocks`` blocks.
    """
    count = min(n, blocks, max(16, n // 8))
    return (np.arange(count, dtype=np.intp) * n) // count


def block_moments(left: Floats, right: Floats, starts: NDArray[np.intp]) -> Floats:
    """Return left^T right summed over each block, shape (m, c, d), from columns of shape (n, c) and (n, d)."""
    edges = [*starts, len(left)]
    return np.stack([left[i:j].T @ right[i:j] for i, j in itertools.pairwise(edges)])
