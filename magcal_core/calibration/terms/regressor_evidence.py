"""Does a housekeeping column bear evidence of its own, beside every smooth bias that the session may have had?

Notes
-----
Blocks of one session share its drift: whatever is smooth explains some of it. So a column is held against two families
of smooth terms of every size: those of orbit and heat, and cosines of 1, 2, .. half waves a session, down to 600 s,
with a size that falls as 1 / k: what remembers for minutes is none of the noise that the likelihood takes it for.
Beside each pair of sizes the three coefficients of the column have sizes of 0.3, 1 and 3 standard deviations of the
residual, and

    log BF = log mean over all sizes of p(with it) - log mean of p(without),

p as in `evidence` with k = 1. And it must beat 39 surrogates of itself: its cosine transform over the session under
random signs, which keeps spectrum and trends.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Rows, rows_of
from magcal_core.calibration.terms.evidence import ABSENT, SIZES
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations

Terms = Sequence[Floats]
"""Columns of one candidate, each of shape (n,), the same for all axes, or (n, 3), one for each."""

ENOUGH: Final = 8.0
"""Smallest log BF of a column that is taken."""
ABOVE_SURROGATES: Final = 3.0
"""By how much its log BF must be above that of every surrogate."""
SURROGATES: Final = 39
COLUMN_SIZES: Final = (0.3, 1.0, 3.0)
SHORTEST_S: Final = 600.0
MOST_COSINES: Final = 120
MOST_ROWS: Final = 4000
"""Samples, evenly spaced, that evidence is taken from."""


@dataclass(frozen=True, slots=True)
class ColumnEvidence:
    """Logarithm of the Bayes factor of a column, and the largest of its surrogates (None where none was drawn)."""

    log_evidence: float
    surrogate_max: float | None = None

    @property
    def is_enough(self) -> bool:
        """Whether the column is taken."""
        if self.log_evidence < ENOUGH or self.surrogate_max is None:
            return False
        return self.log_evidence >= self.surrogate_max + ABOVE_SURROGATES


def smooth_columns(t_s: Floats, locked: LockedColumns | None) -> tuple[Floats, NDArray[np.intp]]:
    """Return the smooth columns, shape (n, t), and the family of each: 0 orbit and heat, 1 cosines over k.

    ``locked``: the columns of `locked_columns` at the same times ``t_s``, shape (n,).
    """
    first = np.zeros((len(t_s), 0)) if locked is None else locked.only(("orbit", "heat")).columns
    span_s = max(float(t_s[-1] - t_s[0]), 1e-9)
    count = min(int(2.0 * span_s / SHORTEST_S), MOST_COSINES)
    k = np.arange(1, count + 1)
    waves = np.sqrt(2.0) * np.cos(np.pi * np.outer((t_s - t_s[0]) / span_s, k)) / k
    family = np.repeat([0, 1], [first.shape[1], count])
    return np.column_stack([first, waves]), family.astype(np.intp)


def evidence_of(
    rows: Rows, smooth: tuple[Floats, NDArray[np.intp]], candidates: Mapping[str, Terms]
) -> Mapping[str, float]:
    """Return log BF of every candidate beside the smooth terms; those that are constant are left out."""
    useful = {name: made for name, terms in candidates.items() if (made := _standardised(terms, rows.used)) is not None}
    if not useful:
        return {}
    task = _Task.of(rows, smooth, [term for terms in useful.values() for term in terms])
    without = np.array([task.log_likelihood(pair) for pair in _PAIRS])
    prior = np.array([sum(_LOG_PRIOR[size] for size in pair) for pair in _PAIRS])
    edges = np.cumsum([0, *(len(terms) for terms in useful.values())])
    found = np.zeros((len(useful), len(_PAIRS), len(COLUMN_SIZES)))
    for i, pair in enumerate(_PAIRS):
        found[:, i] = task.gains(pair, edges)
    top = _log_mean(without + prior)
    means = [_log_mean((gains + (without + prior)[:, None]).ravel()) for gains in found]
    return {name: mean - top for name, mean in zip(useful, means, strict=True)}


def surrogates_of(
    rows: Rows, smooth: tuple[Floats, NDArray[np.intp]], terms: Terms, t_s: Floats, random: np.random.Generator
) -> float:
    """Return the largest log BF of `SURROGATES` surrogates of a candidate, sizes of the families where likeliest."""
    made = _standardised(terms, rows.used)
    if made is None:
        return float("inf")
    drawn = [_surrogate(made, t_s, random) for _ in range(SURROGATES)]
    task = _Task.of(rows, smooth, [term for surrogate in drawn for term in surrogate])
    logs = [task.log_likelihood(pair) + sum(_LOG_PRIOR[size] for size in pair) for pair in _PAIRS]
    edges = np.arange(len(drawn) + 1) * len(made)
    gains = task.gains(_PAIRS[int(np.argmax(logs))], edges)
    return max(_log_mean(one) for one in gains)


_PAIRS: Final = tuple((first, second) for first in SIZES for second in SIZES)
_LOG_PRIOR: Final = {size: float(np.log((1.0 - ABSENT) / (len(SIZES) - 1) if size else ABSENT)) for size in SIZES}


def _log_mean(logs: Floats) -> float:
    top = float(logs.max())
    return top + float(np.log(np.mean(np.exp(logs - top))))


def _standardised(terms: Terms, used: NDArray[np.bool_]) -> list[Floats] | None:
    """Return the terms centred and of unit root mean square over the used samples; None where one is constant."""
    made = []
    for term in terms:
        centred = term - term[used].mean(axis=0)
        spread = np.sqrt(np.mean(centred[used] ** 2, axis=0))
        if not np.all(spread > 0):
            return None
        made.append(centred / spread)
    return made


def _surrogate(terms: Sequence[Floats], t_s: Floats, random: np.random.Generator) -> list[Floats]:
    """Return the terms with the signs of their cosine transforms redrawn, the same for all terms of a candidate."""
    from scipy.fft import dct, idct

    signs = random.choice([-1.0, 1.0], size=len(t_s))
    made = []
    for term in terms:
        turned = signs if term.ndim == 1 else signs[:, None]
        made.append(np.asarray(idct(turned * dct(term, axis=0, norm="ortho"), axis=0, norm="ortho")))
    return made


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """Moments with the parameters eliminated: of the smooth terms, and of the candidates' terms beside them.

    Attributes
    ----------
    families : shape (f,)
        Family of each smooth term.
    m, v : shape (f, f), (f,)
    across : shape (f, c)
        Of smooth terms and candidates.
    own, slope : shape (c, c), (c,)
        Of the candidates.
    squares : float
    freedom : int
    """

    families: NDArray[np.intp]
    m: Floats
    v: Floats
    across: Floats
    own: Floats
    slope: Floats
    squares: float
    freedom: int

    @classmethod
    def of(cls, rows: Rows, smooth: tuple[Floats, NDArray[np.intp]], terms: Sequence[Floats]) -> _Task:
        columns, family = smooth
        q, f, c = rows.unknowns.size, 3 * columns.shape[1], 3 * len(terms)
        total = np.zeros((q + f + c + 1, q + f + c + 1))
        stacked = np.stack(
            [term if term.ndim == 2 else np.broadcast_to(term[:, None], (len(term), 3)) for term in terms], 1
        )
        for channel in rows.channels:
            axes = list(channel.axes)
            smooth_part = (columns[:, :, None] * channel.carriers[:, None, :]).reshape(len(columns), -1)
            own_part = (stacked[:, :, axes] * channel.carriers[:, None, :]).reshape(len(columns), -1)
            at = [*channel.places, *(q + channel.terms_at(columns.shape[1]))]
            at += [*(q + f + channel.terms_at(len(terms))), q + f + c]
            design = np.column_stack([channel.jacobian, smooth_part, own_part, channel.y])
            total[np.ix_(at, at)] += design.T @ design
        found = scaled_inverse(total[:q, :q]) @ total[:q, q:]
        rest = total[q:, q:] - total[:q, q:].T @ found
        return cls(
            np.repeat(family, 3),
            rest[:f, :f],
            rest[:f, -1],
            rest[:f, f:-1],
            rest[f:-1, f:-1],
            rest[f:-1, -1],
            float(rest[-1, -1]),
            rows.freedom,
        )

    def _left(self, pair: tuple[float, float]) -> tuple[Floats, Floats]:
        """Return the factor of the smooth terms that have a size, and their roots."""
        roots = np.array(pair)[self.families]
        used = roots > 0
        scaled = roots[used]
        matrix = scaled[:, None] * self.m[np.ix_(used, used)] * scaled + np.eye(len(scaled))
        return np.linalg.cholesky(matrix), roots

    def log_likelihood(self, pair: tuple[float, float]) -> float:
        """Return the logarithm of the likelihood without a candidate, under the sizes ``pair`` of the families."""
        from scipy.linalg import solve_triangular

        factor, roots = self._left(pair)
        used = roots > 0
        half = solve_triangular(factor, roots[used] * self.v[used], lower=True)
        left = max(self.squares - float(half @ half), 1e-300)
        return -float(np.log(np.diag(factor)).sum()) - 0.5 * self.freedom * float(np.log(left))

    def gains(self, pair: tuple[float, float], edges: NDArray[np.intp]) -> Floats:
        """Return what each candidate's terms, from one of ``edges`` to the next, add to it, (candidates, sizes)."""
        from scipy.linalg import solve_triangular

        factor, roots = self._left(pair)
        used = roots > 0
        right = roots[used, None] * np.column_stack([self.across[used], self.v[used]])
        half = solve_triangular(factor, right, lower=True)
        carried, last = half[:, :-1], half[:, -1]
        squares = max(self.squares - float(last @ last), 1e-300)
        slope = self.slope - carried.T @ last
        found = np.zeros((len(edges) - 1, len(COLUMN_SIZES)))
        for i, (first, end) in enumerate(itertools.pairwise(3 * edges)):
            part = slice(int(first), int(end))
            own = self.own[part, part] - carried[:, part].T @ carried[:, part]
            for j, size in enumerate(COLUMN_SIZES):
                matrix = size**2 * own + np.eye(len(own))
                gain = size**2 * float(slope[part] @ np.linalg.solve(matrix, slope[part]))
                share = max(1.0 - gain / squares, 1e-300)
                found[i, j] = -0.5 * float(np.linalg.slogdet(matrix)[1]) - 0.5 * self.freedom * float(np.log(share))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class SmoothBias:
    """Every smooth bias that one session may have had, and the evidence of columns beside it.

    Attributes
    ----------
    locked : LockedColumns, optional
        The columns of `locked_columns`, of all samples; None where nothing is known that a bias could be locked to.
    seed : int
        What surrogates are drawn with.
    """

    locked: LockedColumns | None
    seed: int

    def weigh(self, observations: Observations, fit: Fit, candidates: Mapping[str, Terms]) -> Mapping[str, float]:
        """Return log BF of every candidate beside ``fit``, which has the terms that are taken already."""
        rows, smooth, few = self._rows(observations, fit)
        return evidence_of(rows, smooth, {name: [term[few] for term in terms] for name, terms in candidates.items()})

    def against_surrogates(
        self, observations: Observations, fit: Fit, terms: Terms, log_evidence: float
    ) -> ColumnEvidence:
        """Return the evidence of one candidate with the largest of its surrogates."""
        rows, smooth, few = self._rows(observations, fit)
        random = np.random.default_rng(self.seed)
        largest = surrogates_of(rows, smooth, [term[few] for term in terms], observations.t_s[few], random)
        return ColumnEvidence(log_evidence, largest)

    def _rows(self, observations: Observations, fit: Fit) -> tuple[Rows, tuple[Floats, NDArray[np.intp]], slice]:
        few = slice(None, None, max(1, -(-len(observations) // MOST_ROWS)))
        part = replace(fit, residuals_nt=fit.residuals_nt[few], weights=fit.weights[few])
        some = replace(observations.take(few), rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)
        locked = None if self.locked is None else replace(self.locked, columns=self.locked.columns[few])
        return rows_of(some, part), smooth_columns(some.t_s, locked), few
