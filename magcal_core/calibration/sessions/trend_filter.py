"""A history of parameters as a random walk with scatter: filters in both directions, over a grid of walks and scatters.

Notes
-----
    y_i = x(t_i) + s_i + e_i       e_i ~ N(0, C_i),  s_i ~ N(0, r^2 I)
    x(t + dt) = x(t) + w           w ~ N(0, q^2 dt I)

Start and jumps add variance 1. The walk is reversible: the same filter runs over the reversed series, and the state at
any time is the product of what both sides say of it, the diffuse start counted once. All values are shares (bias /
40,000 nT, scale / its median, rad) less a centre, so that a variance of 1 is as good as unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats

"""The groups of three that walk, scatter and jump each on their own."""
DIFFUSE: Final = 1.0
"""Variance, share^2, of a start, and of a jump."""


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """The sets that count, in the order of time.

    Attributes
    ----------
    years : shape (n,)
        Times, years of 365.25 d from the first one.
    values, covariances : shape (n, 9), (n, 9, 9)
        Shares less the centre.
    jumps : tuple of (group, interval)
        Interval j lies between the sets j and j + 1.
    """

    years: Floats
    values: Floats
    covariances: Floats
    jumps: tuple[tuple[int, int], ...] = ()

    def __len__(self) -> int:
        return len(self.years)

    def jumped(self) -> Floats:
        """Return the variance that jumps add in each interval, to each parameter, shape (n - 1, 9)."""
        added = np.zeros((max(len(self) - 1, 0), 9))
        for group, interval in self.jumps:
            added[interval, 3 * group : 3 * group + 3] = DIFFUSE
        return added

    def without(self, index: int) -> History:
        """Return the history without one set; a jump stays between the neighbours that are left."""
        jumps = {(group, j - (j >= index)) for group, j in self.jumps}
        kept = np.arange(len(self)) != index
        inside = tuple(sorted((group, j) for group, j in jumps if 0 <= j < len(self) - 2))
        return History(self.years[kept], self.values[kept], self.covariances[kept], inside)


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """One pass: states before and after each set, shape (n, ..., d) and (n, ..., d, d), and log L, shape (...)."""

    before: Floats
    before_covariance: Floats
    after: Floats
    after_covariance: Floats
    log_likelihood: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """Both passes over one series, sets in the order of time in both, with the walk that they ran with.

    ``walks``: q^2 of each parameter, shape (..., d). ``jumped``: variance added by jumps, shape (n - 1, ..., d).
    """

    years: Floats
    walks: Floats
    jumped: Floats
    forward: Filtered
    backward: Filtered

    def of_grid(self, points: NDArray[np.intp]) -> Passes:
        """Return the passes at some ``points`` of a grid alone."""

        def of(one: Filtered) -> Filtered:
            return Filtered(
                one.before[:, :, points],
                one.before_covariance[:, :, points],
                one.after[:, :, points],
                one.after_covariance[:, :, points],
                one.log_likelihood[:, points],
            )

        jumped = self.jumped[:, :, points]
        return Passes(self.years, self.walks[:, points], jumped, of(self.forward), of(self.backward))

    def at(self, years: Floats) -> tuple[Floats, Floats]:
        """Return the states at ``years``, shape (m,): means (m, ..., d) and covariances (m, ..., d, d).

        Inside the interval of a jump the nearer side counts: what the far side says has gone through the jump.
        """
        last = len(self.years) - 1
        left = np.clip(np.searchsorted(self.years, years, side="right") - 1, 0, last)
        is_first, is_last = years < self.years[0], years >= self.years[-1]
        means = np.empty((len(years), *self.walks.shape))
        covariances = np.empty((*means.shape, means.shape[-1]))
        after, before = is_last & ~is_first, np.flatnonzero(is_first)
        means[after], covariances[after] = self._moved(self.forward, left[after], years[after] - self.years[-1])
        means[before], covariances[before] = self._moved(self.backward, left[before], self.years[0] - years[before])
        inside = np.flatnonzero(~is_first & ~is_last)
        if len(inside):
            means[inside], covariances[inside] = self._between(years[inside], left[inside])
        return means, covariances

    def _between(self, years: Floats, left: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return the states at ``years`` from the sets ``left`` and the ones after them."""
        since, until = years - self.years[left], self.years[left + 1] - years
        forward, p_forward = self._moved(self.forward, left, since)
        backward, p_backward = self._moved(self.backward, left + 1, until)
        is_far = (since > until).reshape(-1, *[1] * self.walks.ndim)
        through = self.jumped[left]
        return product(
            forward, p_forward + _diagonal(is_far * through), backward, p_backward + _diagonal(~is_far * through)
        )

    def _moved(self, side: Filtered, index: NDArray[np.intp], years: Floats) -> tuple[Floats, Floats]:
        walked = np.maximum(years, 0.0).reshape(-1, *[1] * self.walks.ndim) * self.walks
        return side.after[index], side.after_covariance[index] + _diagonal(walked)


def both_passes(history: History, walks: Floats, scatters: Floats, *, by_group: bool) -> Passes:
    """Return both passes over the history.

    ``walks``, ``scatters``: q^2 and r^2. With ``by_group`` of a grid, shape (k,): each group runs on its own block, the
    states have shape (n, 3, k, 3). Else of each parameter, shape (9,), and all run together, (n, 9).
    """
    values, noises, jumped = history.values, history.covariances, history.jumped()
    if by_group:
        n = len(history)
        values = values.reshape(n, 3, 1, 3)
        noises = np.stack([noises[:, i : i + 3, i : i + 3] for i in (0, 3, 6)], axis=1)[:, :, None]
        jumped = jumped.reshape(len(jumped), 3, 1, 3)
        walks = np.broadcast_to(walks[None, :, None], (3, len(walks), 3))
        scatters = np.broadcast_to(scatters[None, :, None], walks.shape)
    noises = noises + _diagonal(scatters)
    gaps = np.diff(history.years)
    added = gaps.reshape(-1, *[1] * walks.ndim) * walks + jumped
    forward = _pass(values, noises, added)
    backward = _pass(values[::-1], noises[::-1], added[::-1])
    turned = Filtered(
        backward.before[::-1],
        backward.before_covariance[::-1],
        backward.after[::-1],
        backward.after_covariance[::-1],
        backward.log_likelihood,
    )
    return Passes(history.years, walks, np.broadcast_to(jumped, added.shape), forward, turned)


def _pass(values: Floats, noises: Floats, added: Floats) -> Filtered:
    """Return one pass over ``values``, shape (n, ..., d), with ``noises`` and with the variances ``added`` between."""
    n, shape, d = len(values), noises.shape[1:-1], noises.shape[-1]
    before, after = np.empty((n, *shape)), np.empty((n, *shape))
    before_covariance, after_covariance = np.empty((n, *shape, d)), np.empty((n, *shape, d))
    mean, covariance = np.zeros(shape), np.broadcast_to(DIFFUSE * np.eye(d), (*shape, d))
    total = np.zeros(shape[:-1])
    for i in range(n):
        if i:
            covariance = covariance + _diagonal(added[i - 1])
        before[i], before_covariance[i] = mean, covariance
        spread = covariance + noises[i]
        inverse = np.linalg.inv(spread)
        surprise = values[i] - mean
        told = np.matmul(inverse, surprise[..., None])[..., 0]
        total += np.linalg.slogdet(spread)[1] + np.sum(surprise * told, axis=-1)
        mean = mean + np.matmul(covariance, told[..., None])[..., 0]
        # R S^-1 P rather than P - P S^-1 P: nothing is lost beside a diffuse P.
        settled = np.matmul(noises[i], np.matmul(inverse, covariance))
        covariance = 0.5 * (settled + np.swapaxes(settled, -1, -2))
        after[i], after_covariance[i] = mean, covariance
    return Filtered(before, before_covariance, after, after_covariance, -0.5 * total)


def product(first: Floats, p_first: Floats, second: Floats, p_second: Floats) -> tuple[Floats, Floats]:
    """Return the normal law that two sides make together, the diffuse start (mean 0) counted once."""
    d = first.shape[-1]
    one, other = np.linalg.inv(p_first), np.linalg.inv(p_second)
    both = np.linalg.inv(one + other - np.eye(d) / DIFFUSE)
    covariance = np.asarray(0.5 * (both + np.swapaxes(both, -1, -2)), np.float64)
    weighed = np.matmul(one, first[..., None]) + np.matmul(other, second[..., None])
    return np.matmul(covariance, weighed)[..., 0], covariance


def squared_distance(difference: Floats, covariance: Floats) -> Floats:
    """Return d' V^-1 d over the last axis, shape (...)."""
    told = np.linalg.solve(covariance, difference[..., None])[..., 0]
    return np.asarray(np.sum(difference * told, axis=-1))


def _diagonal(variances: Floats) -> Floats:
    """Return diagonal matrices, shape (..., d, d), of ``variances``, shape (..., d)."""
    return np.asarray(variances[..., None] * np.eye(variances.shape[-1]))
