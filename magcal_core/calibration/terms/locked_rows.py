"""Rows of a fit beside locked columns: how far they remember each other, what a family does, what unseen blocks say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Moments, Rows
from magcal_core.calibration.terms.evidence import Reduced
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.terms.locked_posterior import Posterior
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.numerics.linear_algebra import scaled_inverse, scaled_solution
from magcal_core.observations import Observations

CLIP: Final = 6.0
"""Largest held-out residual that counts in full, in standard deviations."""
_LEAST_ROWS: Final = 5
_MOST_LAGS: Final = 400
_LARGEST: Final = 3.0
"""Size of every family under which all terms are taken off before the memory of the rest is estimated."""


@dataclass(frozen=True, slots=True)
class FamilyRecord:
    """What the data say of one family: its probability, its size in the residual and along the axes, nT."""

    probability: float
    rms_nt: float
    sizes_nt: tuple[float, float, float]

    def to_dict(self) -> dict[str, object]:
        """Return the family as the records have it."""
        return {"probability": self.probability, "rms_nt": self.rms_nt, "sizes_nt": list(self.sizes_nt)}


@dataclass(frozen=True, slots=True, eq=False)
class LockedModel:
    """The rows about one estimate, the columns beside them, and the posterior of everything that they are linear in."""

    rows: Rows
    columns: LockedColumns
    posterior: Posterior

    @classmethod
    def at(cls, rows: Rows, columns: LockedColumns, moments: Moments, sizes: tuple[float, ...]) -> LockedModel:
        """Return the model of ``rows``, whose ``moments`` with ``columns`` are given, over ``sizes`` of each family."""
        reduced = Reduced.of(moments.total, moments.known)
        share = effective_share(rows, columns.columns, reduced)
        posterior = Posterior.of(moments, reduced, columns.locked_families, share, rows.count, sizes)
        return cls(rows, columns, posterior)

    def records(self) -> Mapping[str, FamilyRecord]:
        """Return what the data say of each family."""
        mixture = self.posterior.mixture
        present, a = mixture.present(), mixture.term.reshape(-1, 3)
        nothing = np.zeros(self.posterior.moments.known)
        found = {}
        for i, name in enumerate(self.columns.names):
            of_family = np.array([family == name for family in self.columns.families])
            part = np.where(of_family[:, None], a, 0.0)
            squares = np.zeros(3)
            waves = np.mean((self.columns.columns @ part)[self.rows.used] ** 2, axis=0)
            residual = 0.0
            for channel in self.rows.channels:
                axes = list(channel.axes)
                squares[axes] = waves[axes] * channel.sigma_nt**2
                residual += channel.sigma_nt**2 * self._square(
                    channel.left(self.columns.columns, nothing, part), channel.y
                )
            rms = float(np.sqrt(residual / self.rows.count))
            sizes = np.sqrt(squares)
            found[name] = FamilyRecord(float(present[i]), rms, (float(sizes[0]), float(sizes[1]), float(sizes[2])))
        return found

    @staticmethod
    def _square(left: Floats, y: Floats) -> float:
        term = y - left
        return float(term @ term)


def softening_of(rows: Rows, moments: Moments, fit: Fit) -> float:
    """Return what a robust loss divides the fit's normal matrix by, from the formal variances of the bias; else 1."""
    if fit.robust == "none":
        return 1.0
    own = fit.blocks.to_parameters[:3]
    theirs = own @ np.linalg.pinv(fit.blocks.normals.sum(axis=0), hermitian=True) @ own.T
    mine = rows.unknowns.to_parameters(rows.matrix)[:3]
    plain = mine @ scaled_inverse(moments.total[: moments.known, : moments.known]) @ mine.T
    # The scalar fit's normal matrix is of nT; that of components stands over their deviations already.
    unit = rows.channels[0].sigma_nt ** 2 if len(rows.channels) == 1 else 1.0
    return float(np.trace(theirs) / np.trace(plain)) * unit


def effective_share(rows: Rows, columns: Floats, reduced: Reduced) -> float:
    """Return how much a row counts for among rows that remember each other (k), from what all terms leave."""
    a = largest_terms(reduced)
    d = np.asarray(reduced.offset - reduced.carry @ a)
    products = products_of(rows, columns, d, a)
    return share_of(products[1:] / products[0], rows.count) if products[0] > 0.0 else 1.0


def largest_terms(reduced: Reduced) -> Floats:
    """Return the terms, shape (f,), where each may have the largest size."""
    return np.asarray(np.linalg.solve(reduced.m + np.eye(len(reduced.v)) / _LARGEST**2, reduced.v), np.float64)


def products_of(rows: Rows, columns: Floats, d: Floats, a: Floats, over: Floats | None = None) -> Floats:
    """Return sums of products of y - J d - F a with itself at lags of 0, 1, ..., up to the first that is noise.

    That is, below 2 / root rows of the first; at most 400. ``over``, shape (channels,): what divides each channel.
    """
    left = [channel.left(columns, d, a.reshape(-1, 3)) for channel in rows.channels]
    if over is not None:
        left = [e / deviation for e, deviation in zip(left, over, strict=True)]
    found = [sum(float(e @ e) for e in left)]
    least = 2.0 / np.sqrt(rows.count) * found[0]
    for lag in range(1, min(_MOST_LAGS, len(left[0]) - 1) + 1):
        found.append(sum(float(e[lag:] @ e[:-lag]) for e in left))
        if found[-1] < least:
            break
    return np.array(found)


def share_of(correlations: Floats, count: int) -> float:
    """Return k = 1 / (1 + 2 sum of the autocorrelations) of ``count`` rows, until the first below 2 / root rows."""
    below = np.flatnonzero(correlations < 2.0 / np.sqrt(count))
    kept = correlations[: below[0]] if len(below) else correlations
    return float(1.0 / (1.0 + 2.0 * float(np.sum(kept))))


def held_out(about: LockedModel, folds: NDArray[np.intp], o: Observations) -> Floats:
    """Return the residual of each unseen block with the likeliest terms over that without any, shape (m,)."""
    moments = about.posterior.moments
    roots, known = about.posterior.likeliest, moments.known
    edges = folds_of(o.t_s)
    if not roots.any():
        return np.ones(len(edges))
    used = np.flatnonzero(roots > 0)
    take = np.concatenate([np.arange(known), known + used])
    prior = np.concatenate([np.zeros(known), 1.0 / roots[used] ** 2])
    groups, total, ratios = moments.merged(folds).blocks, moments.total, []
    columns = about.columns.columns
    for fold, own in zip(edges, groups, strict=True):
        if np.count_nonzero(about.rows.used[fold]) < _LEAST_ROWS:
            continue
        rest = total - own
        plain = _solved(rest[:known, :known], rest[:known, -1])
        both = _solved(rest[np.ix_(take, take)] + np.diag(prior), rest[take, -1])
        if plain is None or both is None:
            continue
        a = np.zeros(len(roots))
        a[used] = both[known:]
        sizes = [_clipped(about.rows, columns, fold, *model) for model in ((plain, 0.0 * a), (both[:known], a))]
        ratios.append(sizes[1] / max(sizes[0], 1e-300))
    return np.array(ratios) if ratios else np.ones(1)


def _solved(normal: Floats, right: Floats) -> Floats | None:
    """Return the solution under a unit diagonal; None where the rest of the data does not determine it."""
    try:
        return scaled_solution(normal, right)
    except np.linalg.LinAlgError:
        return None


def _clipped(rows: Rows, columns: Floats, fold: slice, d: Floats, a: Floats) -> float:
    """Return the root mean square of the rows of ``fold`` less J d + F a, each counted up to `CLIP`."""
    squares, count = 0.0, 0
    for channel in rows.channels:
        left = channel.part(fold).left(columns[fold], d, a.reshape(-1, 3))[rows.used[fold]]
        size = np.minimum(np.abs(left), CLIP)
        squares, count = squares + float(size @ size), count + len(size)
    return float(np.sqrt(squares / max(count, 1)))
