"""What electronics make of the reading of a sensor: one function a fault, all in `ELECTRONICS`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np

from magcal_core.arrays import Floats, Mask
from magcal_core.simulation.ranges import Draws

FULL_NT: Final = 50000.0
"""Reading at which a cubic response is off by its share, nT."""

Fault: TypeAlias = Callable[[Draws, Floats], tuple[Floats, Mask]]
"""What is drawn and readings, shape (n, 3), nT, to readings and which of them, shape (n,), still tell of the field."""


def cubic(h_nt: Floats, share: Floats) -> Floats:
    """Return readings of a sensor whose response bends: h + share h (h / `FULL_NT`)^2, axis by axis."""
    return np.asarray(h_nt + share * h_nt * (h_nt / FULL_NT) ** 2)


def quantised(draws: Draws, h_nt: Floats) -> tuple[Floats, Mask]:
    """Return readings that are multiples of the step that is drawn."""
    step_nt = draws.of("step_nt")
    return step_nt * np.rint(h_nt / step_nt), np.ones(len(h_nt), dtype=bool)


def clipped(draws: Draws, h_nt: Floats) -> tuple[Floats, Mask]:
    """Return readings cut at a limit that the share of rows that is drawn goes beyond."""
    largest = np.abs(h_nt).max(axis=1)
    limit_nt = float(np.quantile(largest, 1.0 - draws.of("clipped_share")))
    draws.drawn["limit_nt"] = limit_nt
    return np.clip(h_nt, -limit_nt, limit_nt), largest < limit_nt


def stuck_for_a_stretch(draws: Draws, h_nt: Floats) -> tuple[Floats, Mask]:
    """Return readings of which one axis keeps its value for one stretch of the rows."""
    rows = len(h_nt)
    held = max(2, int(draws.of("stuck_share") * rows))
    first, axis = int(draws.random.integers(0, rows - held + 1)), int(draws.random.integers(3))
    stuck, sound = h_nt.copy(), np.ones(rows, dtype=bool)
    stuck[first : first + held, axis] = h_nt[first, axis]
    sound[first + 1 : first + held] = False
    return stuck, sound


def stuck_throughout(draws: Draws, h_nt: Floats) -> tuple[Floats, Mask]:
    """Return readings of which one axis never changes: no row tells of that axis."""
    stuck, axis = h_nt.copy(), int(draws.random.integers(3))
    stuck[:, axis] = h_nt[0, axis]
    return stuck, np.zeros(len(h_nt), dtype=bool)


ELECTRONICS: Final[Mapping[str, Fault]] = {
    "quantised": quantised,
    "clipped": clipped,
    "stuck for a stretch": stuck_for_a_stretch,
    "stuck throughout": stuck_throughout,
}
