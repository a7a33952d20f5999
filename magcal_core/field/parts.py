"""A pass of a kernel over many samples: in parts, on all cores where there are enough of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Final

import numpy as np

SAMPLES_PER_THREAD: Final = 25_000


def sum_of_parts(n: int, part: Callable[[slice], int], least: int = SAMPLES_PER_THREAD) -> int:
    """Return the sum of what ``part`` returns for slices that make up ``n`` samples; it must not hold the interpreter.

    ``least``: samples that are worth a thread.
    """
    workers = max(1, min(len(os.sched_getaffinity(0)), n // least))
    edges = np.linspace(0, n, workers + 1).astype(int)
    parts = [slice(a, b) for a, b in pairwise(edges)]
    if workers == 1:
        return part(parts[0])
    with ThreadPoolExecutor(workers) as pool:
        return sum(pool.map(part, parts))
