"""The clock's offset before any gate: a scan that bad rows have no part in, scored by least trimmed squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.robust_start import FEW_SUBSETS, Quadric, rows_looked_at

REACH_S: Final = 120.0
"""Offsets that are looked at, s, each way."""
STEP_S: Final = 15.0
LAST_STEP_S: Final = 0.2

FieldAt = Callable[[float], Floats]
"""Offset, s -> |B| at each of the rows, shape (m,), nT."""


@dataclass(frozen=True, slots=True)
class TrimmedClock:
    """Offset, s, whose scale is least, and that scale, nT; ``at_limit``: it lies at an end of the scan."""

    offset_s: float
    scale_nt: float
    at_limit: bool


def clock_rows(n: int) -> NDArray[np.intp]:
    """Return the rows, of ``n``, that a scan looks at."""
    return rows_looked_at(n)


def trimmed_clock(h_nt: Floats, field_at: FieldAt) -> TrimmedClock:
    """Return the offset of the clock that good rows show.

    Parameters
    ----------
    h_nt : shape (m, 3)
        Readings of the rows that are looked at, nT.
    field_at : callable
        |B| at those rows, shape (m,), nT, for an offset in s.

    Notes
    -----
    `STEP_S` apart from -`REACH_S` to `REACH_S`; from the best by halving steps to `LAST_STEP_S`. Each offset is scored
    by the scale that least trimmed squares leave, so that a third of the rows may be anything.
    """
    quadric = Quadric.of(np.ascontiguousarray(h_nt), FEW_SUBSETS)
    scores: dict[float, float] = {}

    def score(offset_s: float) -> float:
        if offset_s not in scores:
            scores[offset_s] = quadric.scale_nt(field_at(offset_s))
        return scores[offset_s]

    count = round(REACH_S / STEP_S)
    best_s = min((STEP_S * i for i in range(-count, count + 1)), key=score)
    step_s = STEP_S / 2.0
    while step_s >= LAST_STEP_S / 2.0:
        best_s = min((best_s - step_s, best_s, best_s + step_s), key=score)
        step_s /= 2.0
    return TrimmedClock(best_s, score(best_s), abs(best_s) > REACH_S - STEP_S / 2.0)
