"""Walk, scatter, jumps and outliers of a history: a grid weighed by likelihood and prior, and changes beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.sessions.trend_filter import (
    History,
    Passes,
    both_passes,
    product,
    squared_distance,
)
from magcal_core.sensor.parameters import GROUPS

SIGNIFICANT_P: Final = 1e-3
"""Probability, over all kinds, groups and places, below which a change is believed."""
FEWEST_FOR_CHANGES: Final = 5
"""With fewer sets neither jumps nor outliers are looked for."""
_ZERO_PRIOR: Final = 0.05
_WALKS: Final = np.concatenate([[0.0], np.geomspace(1e-5, 1.0, 14)])
_SCATTERS: Final = np.concatenate([[0.0], np.geomspace(3e-5, 0.1, 6)])
_WALK_MEDIAN: Final = (3e-3, 1e-3, 1e-3)
_SCATTER_MEDIAN: Final = (3e-4, 1e-4, 1e-4)
"""Median of the prior of each group, share per root year and share: of the bias 120 nT per root year and 12 nT."""
_WALK_DECADES: Final = 0.7
_SCATTER_DECADES: Final = 0.5

GRID_WALKS: Final = np.repeat(_WALKS, len(_SCATTERS))
GRID_SCATTERS: Final = np.tile(_SCATTERS, len(_WALKS))
"""q, share per root year, and r, share, of each point of the grid, shape (105,)."""


def _log_prior() -> Floats:
    """Return the logarithm of the prior of each group at each point of the grid, shape (3, 105)."""

    def of(values: Floats, median: float, decades: float) -> Floats:
        distance = np.log10(values[1:] / median) / decades
        weights = np.exp(-0.5 * distance**2)
        return np.concatenate([[_ZERO_PRIOR], (1.0 - _ZERO_PRIOR) * weights / weights.sum()])

    found = []
    for walk, scatter in zip(_WALK_MEDIAN, _SCATTER_MEDIAN, strict=True):
        both = np.outer(of(_WALKS, walk, _WALK_DECADES), of(_SCATTERS, scatter, _SCATTER_DECADES))
        found.append(np.log(both.ravel()))
    return np.array(found)


LOG_PRIOR: Final = _log_prior()


@dataclass(frozen=True, slots=True)
class Jump:
    """A jump of one group in the interval between the sets ``interval`` and ``interval`` + 1."""

    group: int
    interval: int
    p_value: float


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """A history with the changes that were found in it.

    Attributes
    ----------
    history : the sets that are left, with the jumps.
    kept : shape (m,)
        Which of the sets that were given are left.
    jumps : tuple of Jump
    passes : over the grid, group by group.
    weights : shape (3, 105)
        Posterior of the grid.
    """

    history: History
    kept: NDArray[np.intp]
    jumps: tuple[Jump, ...]
    passes: Passes
    weights: Floats

    def mean_squares(self) -> tuple[Floats, Floats]:
        """Return the posterior means of q^2 and of r^2 of each group, shape (3,) both."""
        return self.weights @ GRID_WALKS**2, self.weights @ GRID_SCATTERS**2


@dataclass(frozen=True, slots=True)
class _Change:
    """What may have changed: one of the groups in an interval, or one set alone."""

    is_jump: bool
    group: int
    place: int
    statistic: float


def explain(history: History) -> Explained:
    """Return the history with every change that is believed, the most significant first."""
    n = len(history)
    kept, jumps = np.arange(n), ()
    found = _weighed(history, kept, jumps)
    if n < FEWEST_FOR_CHANGES:
        return found
    most_jumps, most_alone = (n - 1) // 4, (n - 2) // 4 + 1
    while len(found.history) >= FEWEST_FOR_CHANGES:
        m = len(found.history)
        candidates = _jumps(found) if len(found.jumps) < most_jumps else []
        if n - m < most_alone:
            candidates += _alone(found)
        best = max(candidates, key=lambda one: one.statistic, default=None)
        if best is None:
            break
        p_value = 3 * (2 * m - 5) * chi2_3(best.statistic)
        if not p_value < SIGNIFICANT_P:
            break
        found = _with_jump(found, best, float(p_value)) if best.is_jump else _without_set(found, best.place)
    return found


def without_last(found: Explained) -> Explained:
    """Return the same history, changes and all, without its last set."""
    return _without_set(found, len(found.history) - 1)


def p_value_of_last(found: Explained, others: Explained) -> float:
    """Return the probability of a last set as far as that of ``found`` from what the ``others`` forecast."""
    passes, last = found.passes, len(found.history) - 1
    noise = found.history.covariances[last]
    blocks = np.stack([noise[i : i + 3, i : i + 3] for i in (0, 3, 6)])[:, None]
    spread = passes.forward.before_covariance[last] + blocks + _on_diagonal(GRID_SCATTERS**2)
    difference = found.history.values[last].reshape(3, 1, 3) - passes.forward.before[last]
    p_values = np.sum(others.weights * chi2_3(squared_distance(difference, spread)), axis=1)
    return float(min(1.0, 3.0 * p_values.min()))


def chi2_3(statistic: Floats | float) -> Floats:
    """Return the probability of a chi-square of three degrees of freedom above ``statistic``."""
    from scipy.special import chdtrc

    return np.asarray(chdtrc(3.0, np.maximum(statistic, 0.0)))


def _weighed(history: History, kept: NDArray[np.intp], jumps: tuple[Jump, ...]) -> Explained:
    passes = both_passes(history, GRID_WALKS**2, GRID_SCATTERS**2, by_group=True)
    posterior = passes.forward.log_likelihood + LOG_PRIOR
    weights = np.exp(posterior - posterior.max(axis=1, keepdims=True))
    return Explained(history, kept, jumps, passes, weights / weights.sum(axis=1, keepdims=True))


def _statistics(found: Explained, squares: Floats) -> Floats:
    """Return the statistic of each place and group, shape (k, 3), from D^2 over the grid, shape (k, 3, 105)."""
    posterior = found.passes.forward.log_likelihood + LOG_PRIOR
    return np.asarray(2.0 * ((posterior + 0.5 * squares).max(axis=2) - posterior.max(axis=1)))


def _jumps(found: Explained) -> list[_Change]:
    """Return every jump that there may be: at least two sets on either side, up to the next jump of that group."""
    m, passes = len(found.history), found.passes
    places = np.arange(1, m - 2)
    if not len(places):
        return []
    back, ahead = passes.backward, passes.forward
    walked = np.diff(found.history.years)[places].reshape(-1, 1, 1, 1) * passes.walks
    spread = ahead.after_covariance[places] + back.after_covariance[places + 1] + walked[..., None] * np.eye(3)
    statistics = _statistics(found, squared_distance(back.after[places + 1] - ahead.after[places], spread))
    taken = [{jump.interval for jump in found.jumps if jump.group == group} for group in range(len(GROUPS))]
    return [
        _Change(True, group, int(place), float(statistics[i, group]))
        for i, place in enumerate(places)
        for group in range(len(GROUPS))
        if not taken[group] & {place - 1, place, place + 1}
    ]


def _alone(found: Explained) -> list[_Change]:
    """Return every set, but the first and the last, as one that the others disown."""
    m, passes = len(found.history), found.passes
    places = np.arange(1, m - 1)
    ahead, back = passes.forward, passes.backward
    means, covariances = product(
        ahead.before[places], ahead.before_covariance[places], back.before[places], back.before_covariance[places]
    )
    noises = found.history.covariances[places]
    blocks = np.stack([noises[:, i : i + 3, i : i + 3] for i in (0, 3, 6)], axis=1)[:, :, None]
    difference = found.history.values[places].reshape(-1, 3, 1, 3) - means
    squares = squared_distance(difference, covariances + blocks + _on_diagonal(GRID_SCATTERS**2))
    statistics = _statistics(found, squares)
    return [
        _Change(False, group, int(place), float(statistics[i, group]))
        for i, place in enumerate(places)
        for group in range(len(GROUPS))
    ]


def _with_jump(found: Explained, change: _Change, p_value: float) -> Explained:
    jumps = (*found.jumps, Jump(change.group, change.place, p_value))
    history = replace(found.history, jumps=(*found.history.jumps, (change.group, change.place)))
    return _weighed(history, found.kept, jumps)


def _without_set(found: Explained, index: int) -> Explained:
    history = found.history.without(index)
    moved = [replace(jump, interval=jump.interval - (jump.interval >= index)) for jump in found.jumps]
    inside = tuple(jump for jump in moved if (jump.group, jump.interval) in history.jumps)
    return _weighed(history, np.delete(found.kept, index), inside)


def _on_diagonal(variances: Floats) -> Floats:
    """Return the variances, shape (k,), on the diagonals of 3-by-3 matrices, shape (k, 3, 3)."""
    return np.asarray(variances[:, None, None] * np.eye(3))
