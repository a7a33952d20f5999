"""Rows that cannot be readings: zeros, fill values, stuck stretches, repeated triples, and readings at a limit.

They are flagged, never edited, and no fit has them. What has no mark of its own (a stretch with one axis shifted,
swapped or inverted, spikes) is left to the loss.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask
from magcal_core.samples import SampleFlag, Samples
from magcal_core.telemetry import quality
from magcal_core.units import NT_PER_UNIT

Flags = NDArray[np.uint16]

_EITHER_SIGN: Final = (
    *(32767.0, 65535.0, 2147483647.0),
    *(9999.0, 9999.9, 99999.0, 99999.9, 999999.0),
    *(1e10, 1e20, 1e30, 1e31, 1e38),
)
_ONE_SIGN: Final = (-32768.0, -2147483648.0, 4294967295.0, 8388607.0, -8388608.0, -999.0, -999.9, 9.969209968386869e36)
FILL_VALUES: Final = np.unique([*_ONE_SIGN, *_EITHER_SIGN, *(-value for value in _EITHER_SIGN)])
"""Numbers that loggers, converters and file formats write where there is no reading, ascending."""
_SPELLED: Final = tuple(
    (float(value), spelled) for value in FILL_VALUES for spelled in sorted({float(value), float(np.float32(value))})
)
FOREIGN: Final = 2.0
"""Times the usual step of an axis that a fill value lies from its neighbours; once, where it occurs often."""
_USUAL: Final = 0.95
_OFTEN: Final = 3
_STEPS: Final = 20_000
_AT_ONCE: Final = 1 << 14
_RUN: Final = 3
"""Equal rows that make a stuck stretch at least, and equal triples that are a repeated one at least."""
_LONG_RUN: Final = 10
_REPEATED: Final = 10.0
"""Times the usual count of a triple from which on it is a repeated one."""
_LEVELS: Final = 5
"""Values next to an extreme that say how often one value occurs by itself."""
_PILE: Final = 8.0
"""Times that figure from which on an extreme is a limit: a turning point of a coarse reading has five at most."""
_FINE: Final = 0.9
"""Share of values that occur once from which on an axis is so fine that no extreme repeats by chance."""


def screened(samples: Samples) -> Samples:
    """Return ``samples``, in time order and in any unit, with the rows flagged that cannot be readings."""
    flags = _flags_of_rows(samples.h_nt, samples.is_used)
    return samples if not flags.any() else _flagged(samples, flags)


def unscreened(samples: Samples) -> Samples:
    """Return ``samples`` with only those fill values flagged that no fit has ever had, whatever unit they came in."""
    bit = np.uint16(SampleFlag.FILL_VALUE)
    rows = np.flatnonzero(samples.flags & bit)
    if not rows.size:
        return samples
    is_always = np.zeros(rows.size, dtype=bool)
    for factor in NT_PER_UNIT.values():
        is_always |= np.isin(np.round(samples.h_nt[rows] / factor, 4), quality.FILL_VALUES).any(axis=1)
    flags = samples.flags.copy()
    flags[rows[~is_always]] &= ~bit
    return replace(samples, flags=flags)


def _flagged(samples: Samples, flags: Flags) -> Samples:
    found = samples
    for flag in (
        SampleFlag.ZERO,
        SampleFlag.FILL_VALUE,
        SampleFlag.STUCK,
        SampleFlag.REPEATED,
        SampleFlag.SATURATED,
    ):
        where = (flags & np.uint16(flag)) != 0
        if where.any():
            found = found.flagged(flag, where)
    return found


def _flags_of_rows(h: Floats, used: Mask) -> Flags:
    """Return the flags of fill values, zeros, stuck stretches, repeated triples and limits, shape (n,)."""
    flags = fill_flags(h, used)
    is_left = used & (flags == 0)
    zero = is_left & ~h.any(axis=1)
    flags[zero] = SampleFlag.ZERO
    is_left &= ~zero
    for find, flag in ((stuck, SampleFlag.STUCK), (repeated, SampleFlag.REPEATED), (at_a_limit, SampleFlag.SATURATED)):
        rows = None if is_left.all() else np.flatnonzero(is_left)
        found = find(h if rows is None else h[rows])
        if found.any():
            where = np.flatnonzero(found) if rows is None else rows[found]
            flags[where] |= np.uint16(flag)
            is_left[where] = False
    return flags


def fill_flags(values: Floats, used: Mask) -> Flags:
    """Return `SampleFlag.FILL_VALUE` at rows of ``values``, shape (n, 3), in the file's unit, that hold one.

    ``used``: rows that are looked at, shape (n,). A value counts where it is foreign among its neighbours: the median
    distance from the range of the two nearest rows without it exceeds `FOREIGN` times the 95 % quantile of the steps.
    """
    flags = np.zeros(len(values), np.uint16)
    for axis in range(values.shape[1]):
        column = np.ascontiguousarray(values[:, axis])
        found = _fill_rows(column, used)
        if not found:
            continue
        others = used.copy()
        others[np.concatenate(list(found.values()))] = False
        good = np.flatnonzero(others)
        for value, rows in found.items():
            if _is_foreign(column, value, rows, good):
                flags[rows] = SampleFlag.FILL_VALUE
    return flags


def _fill_rows(column: Floats, used: Mask) -> dict[float, NDArray[np.intp]]:
    """Return fill value -> the rows that hold it, as it is or in single precision."""
    found: dict[float, list[NDArray[np.intp]]] = {}
    for at in range(0, len(column), _AT_ONCE):
        # Some rows at a time: they stay in the processor's cache while every value is looked for.
        cells = column[at : at + _AT_ONCE]
        low, high = np.fmin.reduce(cells), np.fmax.reduce(cells)
        for value, spelled in _SPELLED:
            if low <= spelled <= high:
                rows = np.flatnonzero(cells == spelled)
                if rows.size:
                    found.setdefault(value, []).append(rows + at)
    rows_of = {value: np.unique(np.concatenate(parts)) for value, parts in found.items()}
    kept = {value: rows[used[rows]] for value, rows in rows_of.items()}
    return {value: rows for value, rows in kept.items() if rows.size}


def _is_foreign(column: Floats, value: float, rows: NDArray[np.intp], good: NDArray[np.intp]) -> bool:
    """Return whether a fill value at ``rows`` stands far from the rows beside them that are ``good``."""
    if not good.size:
        return True
    left = np.searchsorted(good, rows)
    before, after = column[good[np.maximum(left - 1, 0)]], column[good[np.minimum(left, good.size - 1)]]
    away = np.maximum(np.minimum(before, after) - value, value - np.maximum(before, after))
    first = np.arange(0, good.size - 1, max(1, good.size // _STEPS))
    steps = np.abs(column[good[first + 1]] - column[good[first]])
    usual = float(np.quantile(steps, _USUAL)) if steps.size else 0.0
    return float(np.median(away)) > (1.0 if rows.size >= _OFTEN else FOREIGN) * usual


def stuck(h: Floats) -> Mask:
    """Return which rows of ``h``, shape (n, 3), belong to a run of equal rows that chance does not make, shape (n,).

    Notes
    -----
    A run has at least max(3, 2 + 1.5 ln n / ln(1/p)) rows, p the share of equal steps outside runs of ten and more, or
    outside the longest tenth of the runs where that is larger: coarse sensors repeat by chance, slow ones for long.
    Where every reading is held for several rows, three times as many.
    """
    n = len(h)
    found = np.zeros(n, dtype=bool)
    if n < _RUN:
        return found
    same = np.zeros(n, dtype=bool)
    same[1:] = h[1:, 0] == h[:-1, 0]
    for axis in (1, 2):
        same[1:] &= h[1:, axis] == h[:-1, axis]
    if not same.any():
        return found
    starts = np.flatnonzero(~same)
    runs = np.diff(np.append(starts, n))
    share = max(_share_of_equal(runs[runs < _LONG_RUN]), _share_of_equal(np.sort(runs)[: len(runs) - len(runs) // 10]))
    by_chance = 2.0 + 1.5 * math.log(n) / math.log(1.0 / share) if share > 0 else 0.0
    held = float(np.median(np.repeat(runs, runs))) if np.median(runs) >= 2 else 1.0
    limit = max(float(_RUN), by_chance, _RUN * held if held > 1 else 0.0)
    for run in np.flatnonzero(runs >= limit):
        found[starts[run] : starts[run] + runs[run]] = True
    return found


def _share_of_equal(runs: NDArray[np.intp]) -> float:
    """Return the share of steps that repeat the row before, over all rows of ``runs`` by their lengths."""
    rows = int(runs.sum())
    return (rows - len(runs)) / rows if rows else 0.0


def repeated(h: Floats) -> Mask:
    """Return which rows of ``h``, shape (n, 3), hold a triple that occurs far more often than others do, shape (n,)."""
    if len(h) < _RUN:
        return np.zeros(len(h), dtype=bool)
    hashes = _hashes(h)
    order = np.sort(hashes)
    edges = np.flatnonzero(order[1:] != order[:-1]) + 1
    if len(edges) == len(order) - 1:
        return np.zeros(len(h), dtype=bool)
    starts = np.append(0, edges)
    counts = np.diff(np.append(starts, len(order)))
    often = np.sort(order[starts[counts >= max(float(_RUN), _REPEATED * float(np.median(counts)))]])
    if not often.size:
        return np.zeros(len(h), dtype=bool)
    place = np.minimum(np.searchsorted(often, hashes), often.size - 1)
    return np.asarray(often[place] == hashes)


def _hashes(h: Floats) -> NDArray[np.uint64]:
    """Return 64 bits of every row: equal rows have equal ones, others the same by a chance of 1e-7 in a million."""
    bits = (h + 0.0).view(np.uint64)
    mixed = np.full(len(h), 0x9E3779B97F4A7C15, dtype=np.uint64)
    for axis in range(3):
        mixed ^= bits[:, axis]
        mixed *= np.uint64(0xFF51AFD7ED558CCD)
        mixed ^= mixed >> np.uint64(33)
        mixed *= np.uint64(0xC4CEB9FE1A85EC53)
        mixed ^= mixed >> np.uint64(29)
    return mixed


def at_a_limit(h: Floats) -> Mask:
    """Return which rows of ``h``, shape (n, 3), have an axis at an extreme where readings pile up, shape (n,).

    The extreme must occur as often as no value next to it does: a coarse reading dwells at its turning point as well.
    """
    found = np.zeros(len(h), dtype=bool)
    if len(h) < _RUN:
        return found
    for axis in range(h.shape[1]):
        column = np.ascontiguousarray(h[:, axis])
        low, high = column.min(), column.max()
        if low == high:
            continue
        for extreme in (low, high):
            at = column == extreme
            count = int(np.count_nonzero(at))
            if count >= _RUN and count >= _pile(column, extreme):
                found |= at
    return found


def _pile(column: Floats, extreme: float) -> float:
    """Return the count from which on an extreme of ``column`` is a limit."""
    away = np.abs(column - extreme)
    away = away[away > 0]
    near = np.sort(np.partition(away, min(64, away.size - 1))[:65]) if away.size > 65 else np.sort(away)
    counts = np.unique(near, return_counts=True)[1]
    usual = float(counts[:_LEVELS].max())
    some = column[:: max(1, len(column) // 20_000)]
    is_fine = len(np.unique(some)) >= _FINE * len(some)
    return float(_RUN) if is_fine and usual <= 1 else _PILE * usual
