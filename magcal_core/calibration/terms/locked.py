"""Errors of the bias that are locked to the orbit or the attitude: what they may have done to the parameters.

Notes
-----
Such an error sits at frequency zero of the scores, which the fit has set to zero: no residual shows it, and intervals
from residuals alone are too small. Here it stands beside the parameters with an a-priori size that the data weigh
(`evidence`), over columns that follow the orbit, heat and light (`locked_columns`). The covariance always knows of
them. The estimate moves by their mean only where every unseen block of time is predicted better for it: on a satellite
that turns once per orbit, such terms are nearly the field itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Moments, Rows, rows_of
from magcal_core.calibration.terms.evidence import SIZES, Mixture, Reduced, mixture_of, require_positive_definite
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance, student_95, with_blocks
from magcal_core.calibration.uncertainty.low_frequencies import low_frequency_variances
from magcal_core.numerics.blocks import BlockScores
from magcal_core.numerics.linear_algebra import scaled_inverse, scaled_solution
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameters import Parameters

Kind = Literal["fit", "clock", "full"]

CERTAIN: Final = 0.95
"""Probability of a family from which on a warning names it."""
BETTER: Final = 0.97
"""Median ratio of the held-out residuals, with terms over without, below which the estimate may move."""
CLIP: Final = 6.0
"""Largest held-out residual that counts in full, in standard deviations."""
MOVE_ERROR: Final = 0.3
"""Standard error of a move that is made, as a share of it."""
COHERENCE: Final = 0.1
"""Root mean square coherence of the unseen part of the sun's term with what parameters do: 0.03 to 0.15 measured."""
_FEW_SIZES: Final = (0.0, 0.3, 3.0)
_LEAST_ROWS: Final = 5
_MOST_LAGS: Final = 400
_BLOCKS: Final = 64
_ROUNDS: Final = 2
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
class LockedTerms:
    """The estimate and its covariance with locked errors considered.

    Attributes
    ----------
    parameters : Parameters
        The fit's, or where they have moved to; those of T_low where all nine elements were unknown.
    matrix : shape (3, 3)
        T at the estimate; full where all nine elements were unknown.
    unknown_covariance : shape (q, q)
        Covariance of the elements of T, the bias and the rest, as `Rows.unknowns` has them.
    covariance : shape (p, p)
        The same of the parameters, in the order of `Parameters.names`; honest variances, no error of the reference.
    widening : shape (p,)
        Honest over posterior standard error (r), at least 1.
    families : name -> FamilyRecord
    effective_share : float
        k.
    moved : bool
    held_out : shape (m,)
        Residual of each unseen block with terms over without.
    unseen_sun_nt : float
        What a term that follows the sun may have across the field, nT; 0 where none is seen or attitude is known.
    plain : Parameters
        Those without any term.
    step : shape (q,)
        Change of the elements of T, the bias and the rest against the fit.
    columns : LockedColumns
        What was held against.
    moments : Moments
        Of the rows about the estimate.
    """

    parameters: Parameters
    matrix: Floats
    unknown_covariance: Floats
    covariance: Floats
    widening: Floats
    families: Mapping[str, FamilyRecord]
    effective_share: float
    moved: bool
    held_out: Floats
    unseen_sun_nt: float
    plain: Parameters
    step: Floats
    columns: LockedColumns
    moments: Moments

    @property
    def shift(self) -> Floats:
        """Estimate less the plain one, shape (p,), in the order of `Parameters.names`."""
        return self.parameters.vector - self.plain.vector

    def honest(self, fit: Fit, samples: int, duration_s: float) -> HonestCovariance:
        """Return the covariance with the blocks of ``fit``, whose samples cover ``duration_s``, s."""
        return with_blocks(self.covariance, fit.blocks, samples, duration_s)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Which families are certain, and that a part of the sun's is not seen."""
        found = [
            f"bias_locked: the bias follows {_WORDS[name]} ({family.rms_nt:.0f} nT root mean square in the residual); "
            "give the temperature or the currents as regressors"
            for name, family in self.families.items()
            if family.probability > CERTAIN
        ]
        if self.unseen_sun_nt > 0.0:
            found.append(
                f"sun_locked: a bias that follows the sun may have {self.unseen_sun_nt:.0f} nT across the field that "
                "|B| does not show; attitude or the panels' currents would"
            )
        return tuple(found)

    def to_dict(self) -> dict[str, object]:
        """Return the terms as the records have them."""
        return {
            "families": {name: family.to_dict() for name, family in self.families.items()},
            "effective_share": self.effective_share,
            "moved": self.moved,
            "held_out": self.held_out.tolist(),
            "unseen_sun_nt": self.unseen_sun_nt,
            "shift": self.plain.with_vector(self.shift).to_dict(),
            "plain": self.plain.to_dict(),
        }


_WORDS: Final = {"orbit": "the orbital period", "heat": "light and shadow", "sun": "the direction of the sun"}


def locked_terms(
    observations: Observations,
    fit: Fit,
    columns: LockedColumns,
    duration_s: float,
    kind: Kind = "fit",
    *,
    always: bool = False,
    never: bool = False,
    known: Moments | None = None,
) -> LockedTerms:
    """Return the estimate with errors locked to ``columns`` considered.

    Parameters
    ----------
    observations, fit
        The fit and what it was made of; with the derivative of the reference where the clock is an unknown.
    duration_s : float
        Time that the samples cover, s.
    kind : {"fit", "clock", "full"}
        ``fit`` has these unknowns itself. ``clock`` was made at a clock that is one unknown more here, and stays the
        plain estimate. ``full``: all nine elements of T are unknown, and the plain estimate is where they lead.
    always : bool
        Move in one step whether unseen blocks bear it out or not, over a coarse grid of sizes: for a test.
    never : bool
        Stay at the plain estimate whatever unseen blocks say: its errors alone are asked for.
    known : Moments, optional
        The moments of the fit, where they have been taken already.
    """
    begun = rows_of(observations, fit, is_full=kind == "full")
    starts, blocks, folds = _edges(observations, fit)
    sizes = _FEW_SIZES if always else SIZES
    about = _Linear.at(begun, columns, known or begun.moments(columns.columns, starts), sizes)
    # What a fit leaves of its own step is no error: its minimum may be that of another residual.
    own_step = about.reduced.offset if kind == "fit" else np.zeros_like(about.reduced.offset)
    first = about.reduced.offset - own_step
    base = first if kind == "full" else np.zeros_like(first)
    ratios = np.ones(1) if always or never else _held_out(about, folds, observations)
    moved = always or bool(np.all(ratios < 1.0) and np.median(ratios) < BETTER)
    end = first + about.mixture.step if moved else base
    for _ in range(_ROUNDS - 1 if moved and not always else 0):
        sigmas = [channel.sigma_nt for channel in begun.channels]
        rows = rows_of(observations, fit, sigmas_nt=sigmas, at=begun.moved(end), is_full=kind == "full")
        about = _Linear.at(rows, columns, rows.moments(columns.columns, starts), SIZES)
        end = end + about.reduced.offset - own_step + about.mixture.step
    matrix, parameters = begun.moved(end)
    spread = about.mixture.covariance(None if moved else base - first)
    sun_nt, unseen = about.unseen_sun()
    more = MOVE_ERROR**2 * np.outer(end - base, end - base) + unseen if not always else unseen
    own = begun.unknowns.to_parameters(matrix)
    in_parameters = own @ spread @ own.T
    widening = about.widening(own, np.diag(in_parameters), blocks, fit, duration_s)
    every = np.ones(len(spread))
    if kind == "full":
        every = about.widening(np.eye(len(spread)), np.diag(spread), blocks, fit, duration_s)
    return LockedTerms(
        parameters=parameters,
        matrix=matrix,
        unknown_covariance=spread * np.outer(every, every) + more,
        covariance=in_parameters * np.outer(widening, widening) + own @ more @ own.T,
        widening=widening,
        families={} if always else about.records(),
        effective_share=about.share,
        moved=moved,
        held_out=ratios,
        unseen_sun_nt=sun_nt,
        plain=begun.moved(base)[1],
        step=end,
        columns=columns,
        moments=about.moments,
    )


def _edges(o: Observations, fit: Fit) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the first samples of fine blocks, and which of these begin the blocks of the scores and the folds."""
    scores = fit.blocks.starts
    if len(scores) > _BLOCKS:
        scores = scores[(np.arange(_BLOCKS) * len(scores)) // _BLOCKS]
    folds = np.array([fold.start for fold in folds_of(o.t_s)], np.intp)
    starts = np.union1d(scores, folds)
    return starts, np.searchsorted(starts, scores), np.searchsorted(starts, folds)


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """The rows about one estimate with the posterior of everything that they are linear in."""

    rows: Rows
    columns: LockedColumns
    moments: Moments
    reduced: Reduced
    share: float
    mixture: Mixture

    @classmethod
    def at(cls, rows: Rows, columns: LockedColumns, moments: Moments, sizes: tuple[float, ...]) -> _Linear:
        reduced = Reduced.of(moments.total, moments.known)
        families = columns.family_of_terms
        share = effective_share(rows, columns.columns, reduced)
        mixture = mixture_of(reduced, families, rows.freedom, share, sizes)
        return cls(rows, columns, moments, reduced, share, mixture)

    @property
    def likeliest(self) -> Floats:
        """Size of every term in the likeliest combination, shape (f,)."""
        return np.asarray(self.mixture.sizes[0][self.columns.family_of_terms])

    def widening(self, own: Floats, posterior: Floats, blocks: NDArray[np.intp], fit: Fit, duration_s: float) -> Floats:
        """Return honest over posterior standard errors, at least 1, from the scores of the likeliest combination.

        ``own``: derivative of what is asked for by the unknowns, shape (p, q); ``posterior``: its variances, (p,).
        """
        roots = self.likeliest
        used = np.flatnonzero(roots > 0)
        known, b = self.moments.known, len(blocks)
        every = np.concatenate([np.arange(known), known + used, [self.moments.blocks.shape[1] - 1]])
        few = Moments(np.ascontiguousarray(self.moments.blocks[:, every[:, None], every]), known)
        merged, take = few.merged(blocks).blocks, np.arange(known + len(used))
        normals = merged[:, :-1, :-1]
        prior = np.concatenate([np.zeros(known), 1.0 / (self.share * roots[used] ** 2)])
        found = np.linalg.solve(normals.sum(axis=0) + np.diag(prior), merged.sum(axis=0)[take, -1])
        scores = merged[:, take, -1] - normals @ found - prior * found / b
        softened = normals / softening_of(self.rows, self.moments, fit) + np.diag(prior) / b
        require_positive_definite(softened.sum(axis=0))
        to_parameters = np.zeros((len(own), len(take)))
        to_parameters[:, :known] = own
        made = BlockScores(scores, softened, blocks, to_parameters)
        variances, frequencies = low_frequency_variances(made, duration_s)
        honest = variances * (student_95(frequencies) / 1.96) ** 2
        formal = np.diag(own @ self.mixture.covariances[0] @ own.T)
        raised = np.maximum(honest / np.maximum(formal, 1e-300), 1.0)
        if not len(used) and len(own) == len(fit.covariance):
            raised = np.maximum(raised, np.diag(fit.covariance) / np.maximum(posterior, 1e-300))
        return np.asarray(np.sqrt(raised))

    def records(self) -> Mapping[str, FamilyRecord]:
        """Return what the data say of each family."""
        present = self.mixture.present()
        a = self.mixture.term.reshape(-1, 3)
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
                    channel.left(self.columns.columns, self._none, part), channel.y
                )
            rms = float(np.sqrt(residual / self.rows.count))
            sizes = np.sqrt(squares)
            found[name] = FamilyRecord(float(present[i]), rms, (float(sizes[0]), float(sizes[1]), float(sizes[2])))
        return found

    @property
    def _none(self) -> Floats:
        return np.zeros(self.moments.known)

    @staticmethod
    def _square(left: Floats, y: Floats) -> float:
        term = y - left
        return float(term @ term)

    def unseen_sun(self) -> tuple[float, Floats]:
        """Return what a term of the sun may have across the field, nT, and what it adds to the covariance, (q, q)."""
        q = self.moments.known
        nothing = np.zeros((q, q))
        if "sun" not in self.columns.names or self.columns.unseen <= 0.0:
            return 0.0, nothing
        at = np.flatnonzero(self.columns.family_of_terms == self.columns.names.index("sun"))
        a, n = self.mixture.term[at], self.rows.count
        squares = self.moments.total[q + at[:, None], q + at]
        seen = float(a @ squares @ a) / n - 2.0 * len(at) / n
        if seen <= 0.0:
            return 0.0, nothing
        size_nt = float(np.sqrt(seen * self.columns.unseen)) * self.rows.channels[0].sigma_nt
        return size_nt, COHERENCE**2 * n * self.columns.unseen * seen * self.reduced.inverse


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
    """Return how much a row counts for among rows that remember each other (k), from what all terms leave.

    Notes
    -----
    k = 1 / (1 + 2 sum of the autocorrelations), until the first one below 2 / root rows, at most 400 lags.
    """
    a = np.asarray(np.linalg.solve(reduced.m + np.eye(len(reduced.v)) / _LARGEST**2, reduced.v), np.float64)
    d = np.asarray(reduced.offset - reduced.carry @ a)
    left = [channel.left(columns, d, a.reshape(-1, 3)) for channel in rows.channels]
    square = sum(float(e @ e) for e in left)
    if square <= 0.0:
        return 1.0
    total, least = 0.0, 2.0 / np.sqrt(rows.count)
    for lag in range(1, min(_MOST_LAGS, len(left[0]) - 1) + 1):
        correlation = sum(float(e[lag:] @ e[:-lag]) for e in left) / square
        if correlation < least:
            break
        total += correlation
    return 1.0 / (1.0 + 2.0 * total)


def _held_out(about: _Linear, folds: NDArray[np.intp], o: Observations) -> Floats:
    """Return the residual of each unseen block with the likeliest terms over that without any, shape (m,)."""
    roots, known = about.likeliest, about.moments.known
    edges = folds_of(o.t_s)
    if not roots.any():
        return np.ones(len(edges))
    used = np.flatnonzero(roots > 0)
    take = np.concatenate([np.arange(known), known + used])
    prior = np.concatenate([np.zeros(known), 1.0 / roots[used] ** 2])
    groups, total, ratios = about.moments.merged(folds).blocks, about.moments.total, []
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


def moved_fit(observations: Observations, fit: Fit, terms: LockedTerms) -> Fit:
    """Return ``fit`` where the estimate moved: its parameters and residuals; the fit itself where it did not."""
    if not terms.moved:
        return fit
    parameters = replace(terms.parameters, time_offset_s=fit.parameters.time_offset_s)
    residual = residuals_nt(observations, terms.parameters, is_vector=fit.residuals_nt.ndim == 2)
    return replace(fit, parameters=parameters, residuals_nt=residual)
