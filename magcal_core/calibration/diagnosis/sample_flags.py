"""Spikes, jumps and saturation, sample by sample, from the residuals of a fit; nothing is edited."""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Mask
from magcal_core.numerics.medians import peaks_above, running_median
from magcal_core.numerics.robust import robust_sigma

SPIKE: Final = 6.0
"""Robust standard deviations from the neighbours beyond which a residual is a spike."""
JUMP: Final = 8.0
"""Times the usual difference between the medians before and after a sample that makes a jump: a wave is no jump."""
JUMP_NOISE: Final = 3.0
"""Standard deviations of the noise, as neighbours show it, that a jump has at least."""
_SIDE: Final = 9
"""Samples on each side whose median is taken."""
_RUN: Final = 3
"""Readings at exactly the largest value of an axis that make it a limit."""


def spikes(residuals: Floats) -> Mask:
    """Return which samples stand far from the fit and from their neighbours, shape (n,), from residuals in nT."""
    size = np.atleast_2d(residuals.T)
    found = np.zeros(size.shape[1], dtype=bool)
    for row in size:
        scale = robust_sigma(row)
        if scale > 0:
            away = _running_median(row)
            np.abs(np.subtract(row, away, out=away), out=away)
            found |= (away > SPIKE * scale) & (np.abs(row) > SPIKE * scale)
    return found


def jumps(residuals: Floats) -> Mask:
    """Return the first sample after each step of the residual, shape (n,)."""
    size = np.atleast_2d(residuals.T)
    found = np.zeros(size.shape[1], dtype=bool)
    if size.shape[1] < 2 * _SIDE + 1:
        return found
    for row in size:
        windows = running_median(np.ascontiguousarray(row), _SIDE)
        step = np.zeros(row.size)
        apart = np.subtract(windows[_SIDE:], windows[:-_SIDE], out=step[_SIDE : row.size - _SIDE + 1])
        np.abs(apart, out=apart)
        del windows
        noise = robust_sigma(np.diff(row)) / np.sqrt(2.0)
        limit = max(JUMP * float(np.median(step)), JUMP_NOISE * noise)
        if limit <= 0:
            continue
        is_peak = peaks_above(step, limit, _SIDE)
        found |= is_peak & ~np.concatenate([[False], is_peak[:-1]])
    return found


def saturated(h_nt: Floats) -> Mask:
    """Return which readings, shape (n, 3), nT, stand at a limit: the extreme of an axis that occurs several times."""
    found = np.zeros(len(h_nt), dtype=bool)
    for column in h_nt.T:
        for extreme in (column.max(), column.min()):
            at = column == extreme
            in_a_row = at[2:] & at[1:-1] & at[:-2] if len(at) >= _RUN else np.zeros(0, dtype=bool)
            if in_a_row.any() and np.ptp(column) > 0:
                found |= at
    return found


def _running_median(row: Floats) -> Floats:
    padded = np.pad(row, 3, mode="reflect") if row.size > 3 else np.pad(row, 3, mode="edge")
    return running_median(np.ascontiguousarray(padded), 7)
