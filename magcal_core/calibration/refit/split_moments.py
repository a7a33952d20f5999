"""Moments of a fit's rows with each axis' residual and clock in columns of their own, so that axes can be weighed anew.

Notes
-----
Every axis of a vector fit stands over the deviation of its own residual. Other unknowns leave other deviations: the
axes then count differently, which a sum over all of them cannot tell. An axis' own unknowns are those of its row of T,
its bias and its slopes; the clock is one for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask
from magcal_core.calibration.estimators.linear_rows import Moments, Rows, block_products
from magcal_core.numerics.linear_algebra import scaled_inverse

_ROWS: Floats = np.array([0, 1, 1, 2, 2, 2, 0, 1, 2])
"""Axis of the six elements of T and of the bias."""


@dataclass(frozen=True, slots=True, eq=False)
class SplitMoments:
    """Products of (J, F, y) by blocks.

    Attributes
    ----------
    blocks : shape (b, w, w)
        The ``inner`` unknowns without the clock; that of each of the ``channels`` where there is one; the terms; the
        residual of each channel.
    axes : shape (inner,)
        Channel of each unknown.
    has_clock : bool
    channels : int
        One, or three axes.
    """

    blocks: Floats
    axes: NDArray[np.intp]
    has_clock: bool
    channels: int

    @property
    def inner(self) -> int:
        """Number of unknowns without the clock."""
        return len(self.axes)

    @property
    def known(self) -> int:
        """Number of unknowns."""
        return self.inner + self.has_clock

    @property
    def total(self) -> Floats:
        """Sum over all blocks, shape (w, w)."""
        return np.asarray(self.blocks.sum(axis=0))

    def as_one_block(self) -> SplitMoments:
        """Return the sum over all blocks as a block of its own: what only totals are asked of costs a block's time."""
        return replace(self, blocks=self.total[None])

    @classmethod
    def of(cls, rows: Rows, columns: Floats, starts: NDArray[np.intp]) -> SplitMoments:
        """Return the moments of ``rows`` with ``columns`` of time, shape (n, t), by blocks that begin at ``starts``."""
        clocks, m, terms = rows.unknowns.clocks, len(rows.channels), 3 * columns.shape[1]
        inner = rows.unknowns.size - clocks
        width = inner + m * clocks + terms + m
        blocks = np.zeros((len(starts), width, width))
        for i, channel in enumerate(rows.channels):
            own = np.where(channel.places < inner, channel.places, inner + i)
            shared = inner + m * clocks + channel.terms_at(columns.shape[1])
            at = np.concatenate([own, shared, [width - m + i]])
            blocks[:, at[:, None], at] += block_products(channel, columns, starts)
        axes = axes_of(inner) if m > 1 else np.zeros(inner, np.intp)
        return cls(blocks, axes, bool(clocks), m)

    def chosen(self, take: NDArray[np.intp], slopes: Floats, shares: Floats) -> SplitMoments:
        """Return those of the unknowns ``take`` where ``slopes``, shape (3 k,), of regressors are taken off.

        ``shares``, shape (b,): how much each block counts; blocks that do not are left out.
        """
        m, width = self.channels, self.blocks.shape[1]
        counts: Mask = shares > 0.0
        blocks = self.blocks[counts] * shares[counts, None, None]
        if slopes.any():
            taken_off, at = np.eye(width), 9 + np.arange(len(slopes))
            taken_off[at, width - m + self.axes[at]] = slopes
            blocks = taken_off.T @ blocks @ taken_off
        inside = take[take < self.inner]
        has_clock = self.has_clock and len(inside) < len(take)
        clocks = self.inner + np.arange(m) if has_clock else np.arange(0)
        kept = np.concatenate([inside, clocks, np.arange(self.inner + m * self.has_clock, width)])
        return replace(self, blocks=blocks[:, kept[:, None], kept], axes=self.axes[inside], has_clock=has_clock)

    def together(self, deviations: Floats | None = None) -> Moments:
        """Return the moments with all axes in one, each over ``deviations``, shape (channels,), of what it leaves."""
        m, width = self.channels, self.blocks.shape[1]
        over = np.ones(m) if deviations is None else 1.0 / deviations
        terms = width - self.inner - m * (self.has_clock + 1)
        summed = np.zeros((width, self.known + terms + 1))
        at = np.arange(self.inner)
        summed[at, at] = over[self.axes]
        if self.has_clock:
            summed[self.inner + np.arange(m), self.inner] = over
        at = np.arange(terms)
        summed[self.inner + m * self.has_clock + at, self.known + at] = 1.0
        summed[width - m + np.arange(m), -1] = over
        return Moments(summed.T @ self.blocks @ summed, self.known)

    def least_squares(self, clock_s: float | None) -> Floats:
        """Return the plain estimate, shape (known,), with the clock at ``clock_s`` where it is an unknown."""
        moments = self.together()
        total, q = moments.total, self.inner
        right = total[:q, -1] if clock_s is None else total[:q, -1] - total[:q, q] * clock_s
        found = scaled_inverse(total[:q, :q]) @ right
        return np.asarray(found if clock_s is None else np.append(found, clock_s))

    def deviations(self, d: Floats, count: int) -> Floats:
        """Return the deviation of what ``d`` leaves of each channel's ``count`` rows, in those they stand over."""
        total, m = self.total, self.channels
        found = np.empty(m)
        for i in range(m):
            own = np.flatnonzero(self.axes == i)
            values = np.concatenate([-d[own], [1.0]])
            at = np.append(own, len(total) - m + i)
            if self.has_clock:
                at, values = np.append(at, self.inner + i), np.append(values, -d[-1])
            square = float(values @ total[np.ix_(at, at)] @ values)
            found[i] = np.sqrt(max(square, 1e-12) / max(count - len(own), 1))
        return found


def axes_of(inner: int) -> NDArray[np.intp]:
    """Return the axis of each of so many unknowns of a vector fit: T, bias, slopes."""
    return np.concatenate([_ROWS, np.arange(inner - 9) % 3]).astype(np.intp)
