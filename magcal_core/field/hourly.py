"""One hourly index from several files: the later one holds, short gaps are bridged, Dst is split in its two parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask, Nanoseconds
from magcal_core.field.index import HOUR_NS, Index

MOST_BRIDGED: Final = 3
"""Missing hours in a row that are bridged linearly: an error of 3.0, 3.9 and 4.6 nT for one, two and three."""
INDUCED_SHARE: Final = 0.264
"""Part of a departure of Dst from the Earth's memory that currents in the Earth add."""
MEMORY_H: Final = 720.0
"""Time constant of that memory, hours."""
MEMORY_START_NT: Final = -13.4
"""Memory before the first hour of the index, nT."""
CELL_NS: Final = HOUR_NS // 2
_MOST_HOURS: Final = 200 * 366 * 24


@dataclass(frozen=True)
class HourlyIndex:
    """RC or Dst hour by hour, from the first hour of its files to the last.

    Attributes
    ----------
    name : str
        ``RC`` or ``Dst``.
    files : tuple of Index
        What it was made of.
    start_ns : int
        Start of the first hour, nanoseconds since 1970, UTC.
    total_nt, external_nt, induced_nt : shape (n,)
        The index and its parts, nT; NaN in gaps of more than `MOST_BRIDGED` hours.
    source : shape (n,)
        Which of the ``files`` gave the hour; -1 where none did.
    has_parts : shape (n,)
        Whether the file gave the two parts; else they are split off the index.
    """

    name: str
    files: tuple[Index, ...]
    start_ns: int
    total_nt: Floats
    external_nt: Floats
    induced_nt: Floats
    source: NDArray[np.int64]
    has_parts: Mask

    @property
    def span(self) -> str:
        """First and last instant with a value, for messages."""
        known = np.flatnonzero(self.source >= 0)
        ends = self.start_ns + np.array([known[0], known[-1] + 1]) * HOUR_NS
        first, last = (np.datetime_as_string(np.datetime64(int(end), "ns"), unit="s") for end in ends)
        return f"{first}Z to {last}Z"

    @cached_property
    def cells(self) -> Floats:
        """The index by half hours, shape (2 n, 4): external part, its slope, induced part, its slope, nT and nT/ns.

        Values at the cell's start. A value is the mean of its hour and stands at its middle; between two middles the
        index is linear, constant where there is no neighbour. NaN where an hour has no value.
        """
        cells = np.full((2 * len(self.total_nt), 4), np.nan)
        for column, value in ((0, self.external_nt), (2, self.induced_nt)):
            before, after = _shifted(value, 1), _shifted(value, -1)
            start = np.where(np.isnan(before), value, 0.5 * (before + value))
            end = np.where(np.isnan(after), value, 0.5 * (after + value))
            cells[0::2, column], cells[0::2, column + 1] = start, (value - start) / CELL_NS
            cells[1::2, column], cells[1::2, column + 1] = value, (end - value) / CELL_NS
        return cells

    def hours(self, stamps_ns: Nanoseconds) -> NDArray[np.int64]:
        """Return the hour of each of ``stamps_ns``, shape (m,); -1 where the index has none."""
        hour = (stamps_ns - self.start_ns) // HOUR_NS
        inside = (hour >= 0) & (hour < len(self.total_nt))
        known = inside & ~np.isnan(self.total_nt[np.where(inside, hour, 0)])
        return np.where(known, hour, -1)

    def parts_at(self, stamps_ns: Nanoseconds) -> Floats:
        """Return the external and the induced part at ``stamps_ns``, shape (m, 2), nT; NaN where there is no value."""
        hour = self.hours(stamps_ns)
        cell = np.where(hour < 0, 0, (stamps_ns - self.start_ns) // CELL_NS)
        elapsed = (stamps_ns - self.start_ns - cell * CELL_NS).astype(np.float64)
        found = self.cells[cell][:, [0, 2]] + elapsed[:, None] * self.cells[cell][:, [1, 3]]
        return np.where(hour[:, None] < 0, np.nan, found)

    def used_hours(self, stamps_ns: Nanoseconds) -> NDArray[np.int64]:
        """Return the hours, ascending, that the index at ``stamps_ns`` depends on: its own and the neighbour's."""
        hour = self.hours(stamps_ns)
        known = hour >= 0
        side = np.where((stamps_ns - self.start_ns) % HOUR_NS < CELL_NS, -1, 1)
        around = np.unique(np.concatenate([hour[known], (hour + side)[known]]))
        around = around[(around >= 0) & (around < len(self.total_nt))]
        return np.asarray(around[~np.isnan(self.total_nt[around])], np.int64)

    def changes_nt(self, stamps_ns: Nanoseconds) -> Floats:
        """Return the change of the index from the hour before to that of each of ``stamps_ns``, shape (m,), nT."""
        hour = self.hours(stamps_ns)
        change = np.abs(self.total_nt - _shifted(self.total_nt, 1))
        return np.where(hour < 0, np.nan, change[np.where(hour < 0, 0, hour)])


def hourly(indices: Sequence[Index], name: str) -> HourlyIndex | None:
    """Return the hourly index ``name`` of all ``indices``, of which the later holds; None where none of them is it."""
    files = tuple(index for index in indices if index.name == name and not np.isnan(index.value).all())
    if not files:
        return None
    start_ns = min(int(index.start_ns[0]) for index in files)
    count = (max(int(index.start_ns[-1]) for index in files) - start_ns) // HOUR_NS + 1
    columns = np.full((3, count), np.nan)
    source = np.full(count, -1, np.int64)
    for number, index in enumerate(files):
        known = ~np.isnan(index.value)
        hour = (index.start_ns[known] - start_ns) // HOUR_NS
        columns[:, hour] = [index.value[known], index.external_nt[known], index.induced_nt[known]]
        source[hour] = number
    has_parts = ~np.isnan(columns[1])
    total_nt = _bridged(columns[0])
    external_nt, induced_nt = split(total_nt)
    given = _bridged(np.where(has_parts, columns[1], np.nan)), _bridged(np.where(has_parts, columns[2], np.nan))
    is_given = has_parts | ((source < 0) & ~np.isnan(given[0]))
    external_nt = np.where(is_given, given[0], external_nt)
    induced_nt = np.where(is_given, given[1], induced_nt)
    return HourlyIndex(name, files, start_ns, total_nt, external_nt, induced_nt, source, is_given)


def split(index_nt: Floats) -> tuple[Floats, Floats]:
    """Return the external and the induced part of Dst, each of shape (n,), nT, from its hours; NaN: no value.

    Notes
    -----
    M <- M + (1 - exp(-1/720)) (D - M) at each hour, -13.4 nT before the first; i = 0.264 (D - M), e = D - i. Hours
    without a value leave M. The Earth answers a change at once and forgets it over a month: a fixed ratio of the parts
    leaves 5.6 nT of |B| where this leaves 4.7.
    """
    from scipy.signal import lfilter  # takes seconds to import, and few sessions need it

    known = ~np.isnan(index_nt)
    gain = -np.expm1(-1.0 / MEMORY_H)
    memory = np.full(len(index_nt), np.nan)
    if known.any():
        values = index_nt[known]
        memory[known], _ = lfilter([gain], [1.0, gain - 1.0], values, zi=[(1.0 - gain) * MEMORY_START_NT])
    induced_nt = INDUCED_SHARE * (index_nt - memory)
    return index_nt - induced_nt, induced_nt


def _bridged(value: Floats) -> Floats:
    """Return ``value``, shape (n,), with runs of at most `MOST_BRIDGED` NaN between two values filled linearly."""
    filled, known = value.copy(), np.flatnonzero(~np.isnan(value))
    gap = np.diff(known) - 1
    for at in np.flatnonzero((gap > 0) & (gap <= MOST_BRIDGED)):
        low, high = known[at], known[at + 1]
        filled[low : high + 1] = np.linspace(value[low], value[high], high - low + 1)
    return filled


def _shifted(value: Floats, by: int) -> Floats:
    """Return ``value`` moved by one place to later (1) or sooner (-1); NaN where nothing is left."""
    moved = np.full_like(value, np.nan)
    if by > 0:
        moved[1:] = value[:-1]
    else:
        moved[:-1] = value[1:]
    return moved
