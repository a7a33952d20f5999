"""What no residual shows, kept with a fit's moments: errors locked to the orbit, and errors of the reference.

Notes
-----
A calibration widens its errors by both. A refit has other unknowns, and the same hidden errors do something else to
them: so not the widening is kept but what it is made from, the products of the rows' derivatives J by *every* unknown
that a refit may ask for with the locked terms F and the residual y (`LockedSums`), and with what errors of the
reference do to the residual (`ReferenceSums`). The posterior under another choice of unknowns, and the shift of its
estimate, are then a selection of rows and columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Moments, Rows, Unknowns, rows_of
from magcal_core.calibration.terms.evidence import SIZES, Reduced
from magcal_core.calibration.terms.locked import BETTER, BLOCKS, FEW_SIZES, MOVE_ERROR, LockedTerms, starts_of
from magcal_core.calibration.terms.locked_posterior import LockedFamilies, Posterior
from magcal_core.calibration.terms.locked_rows import largest_terms, products_of, share_of
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.errors import NotObservableError
from magcal_core.numerics.linear_algebra import is_positive_definite, scaled_inverse
from magcal_core.observations import Observations
from magcal_core.sensor.parameterisation import Standardised
from magcal_core.sensor.parameters import Parameters

LATE: Final = "orbit_along_track"
"""The error of the reference that a clock among the unknowns takes up."""
_LOWER: Final = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
_REFERENCE_BLOCKS: Final = 24
_ROUNDS: Final = 2

Parts = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Which unknowns a refit has, and how much of each block of the sums it counts.

    Attributes
    ----------
    take : shape (p,)
        Places of the unknowns among all.
    columns : Standardised
        Regressors that the moments have; ``names``: those among the unknowns.
    has_clock : bool
    shares, weights : shape (m,)
        Share of each block of the moments' sums that is counted, and its weight.
    """

    take: NDArray[np.intp]
    columns: Standardised
    names: tuple[str, ...]
    has_clock: bool
    shares: Floats
    weights: Floats

    def shares_of(self, firsts: NDArray[np.intp]) -> Floats:
        """Return the share that is counted of groups of blocks, which begin at ``firsts``."""
        whole = np.add.reduceat(self.weights, firsts)
        return np.asarray(np.add.reduceat(self.weights * self.shares, firsts) / np.maximum(whole, 1e-300))

    def to_parameters(self, matrix: Floats, mean: Floats, spread: Floats) -> Floats:
        """Return the derivative of the reported parameters and the clock by the unknowns, shape (p, p)."""
        at = [self.columns.names.index(name) for name in self.names]
        drifts = Standardised(self.names, np.zeros((0, len(at))), mean[at], spread[at])
        return Unknowns(_LOWER, drifts, (), int(self.has_clock)).to_parameters(matrix)


@dataclass(frozen=True, slots=True, eq=False)
class LockedErrors:
    """What locked errors do to one choice of unknowns: covariance of the parameters, shape (p, p).

    ``move``, shape (p,): how far their posterior mean moves the parameters; zero where the calibration did not move.
    """

    covariance: Floats
    move: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LockedSums:
    """Products of (J, F, y) about the calibration, J by all unknowns that may be asked for.

    Attributes
    ----------
    moments : Moments
        By the blocks that the calibration takes its honest errors from.
    places : shape (b,)
        Block of the fit's sums that each block of the moments begins in.
    folds : shape (b,)
        Which of the spans that are left out in turn each block is of.
    families : LockedFamilies
    slopes : shape (3 k,)
        Of all regressors at the calibration, standardised; zero where the fit has none.
    matrix : shape (3, 3)
        T there.
    memory : shape (3, lags + 1)
        Mean products of what all terms leave of a row with what they leave of the rows before: under the unknowns of
        the calibration, under the fewest and under the most. What is left remembers less where more is explained.
    count, softening : int, float
        Number of rows, and what the loss divides their normal matrix by.
    own : shape (p,)
        Unknowns of the calibration.
    moved : bool
        Whether it moved to the posterior mean, by ``move``, shape (q,).
    """

    moments: Moments
    places: NDArray[np.intp]
    folds: NDArray[np.intp]
    families: LockedFamilies
    slopes: Floats
    matrix: Floats
    memory: Floats
    count: int
    softening: float
    own: NDArray[np.intp]
    moved: bool
    move: Floats

    def clock_step_s(self, choice: Choice) -> float:
        """Return the step of the clock beside the locked errors, s; the clock is the last of the unknowns."""
        moments, step_s = self._chosen(choice), 0.0
        for _ in range(_ROUNDS):
            found = self._posterior(choice, moments, step_s, FEW_SIZES)
            step_s = float(found.reduced.offset[-1] + found.mixture.step[-1])
        return step_s

    def errors(self, choice: Choice, duration_s: float) -> LockedErrors:
        """Return what locked errors do to ``choice``; ``duration_s``: time that the samples left cover, s."""
        moments = self._chosen(choice)
        clock_s = self.clock_step_s(choice) if choice.has_clock else None
        found = self._posterior(choice, moments, clock_s, SIZES)
        is_moved = self._moves(choice, found)
        mixture, about = found.mixture, _least_squares(moments, clock_s) - found.reduced.offset
        spread = mixture.covariance(None if is_moved else about)
        move = mixture.step - about if is_moved else np.zeros(len(about))
        more = MOVE_ERROR**2 * np.outer(move, move) + found.unseen_sun()[1]
        own = choice.to_parameters(self.matrix, choice.columns.mean, choice.columns.spread)
        in_parameters = own @ spread @ own.T
        blocks = np.arange(len(moments.blocks))
        widening = found.widening(own, np.diag(in_parameters), blocks, self.softening, duration_s)
        covariance = in_parameters * np.outer(widening, widening) + own @ more @ own.T
        return LockedErrors(covariance, own @ move)

    def _moves(self, choice: Choice, found: Posterior) -> bool:
        """Return whether the posterior mean is the estimate: where every span left out is predicted better by it.

        As the calibration asks (`locked_rows.held_out`), its own answer where nothing else is asked for; residuals
        count in full here.
        """
        shares = choice.shares[self.places]
        if np.array_equal(choice.take, self.own) and (shares == 1.0).all():
            return self.moved
        roots, known = found.likeliest, found.moments.known
        used = np.flatnonzero(roots > 0)
        folds, total, ratios = self.folds[shares > 0.0], found.moments.total, []
        take = np.concatenate([np.arange(known), known + used])
        prior = np.concatenate([np.zeros(known), 1.0 / roots[used] ** 2])
        for fold in np.unique(folds):
            held = found.moments.blocks[folds == fold].sum(axis=0)
            rest = total - held
            squares = []
            for at, ridge in ((take[:known], prior[:known]), (take, prior)):
                normal = rest[np.ix_(at, at)] + np.diag(ridge)
                if not is_positive_definite(normal):
                    return False
                d = scaled_inverse(normal) @ rest[at, -1]
                squares.append(held[-1, -1] - 2.0 * d @ held[at, -1] + d @ held[np.ix_(at, at)] @ d)
            ratios.append(np.sqrt(max(squares[1], 0.0) / max(squares[0], 1e-300)))
        return bool(len(used)) and max(ratios) < 1.0 and float(np.median(ratios)) < BETTER

    def _chosen(self, choice: Choice) -> Moments:
        """Return the moments of the unknowns chosen, with the slopes of all other regressors at zero."""
        shares = choice.shares[self.places]
        counts = shares > 0.0
        blocks = self.moments.blocks[counts] * shares[counts, None, None]
        is_off = np.repeat([name not in choice.names for name in choice.columns.names], 3)
        return _selected(replace(self.moments, blocks=blocks), choice.take, np.where(is_off, self.slopes, 0.0))

    def _posterior(
        self, choice: Choice, moments: Moments, clock_s: float | None, sizes: tuple[float, ...]
    ) -> Posterior:
        """Return the posterior of the ``moments`` chosen over ``sizes``, the plain estimate at the clock's step.

        The sizes of terms are those of the residual's deviation, so the rows stand over what the estimate leaves.
        """
        left = float(choice.weights @ choice.shares / choice.weights.sum())
        count = max(round(self.count * left), moments.known + 1)
        d = _least_squares(moments, clock_s)
        total, q = moments.total, moments.known
        square = float(total[-1, -1] - 2.0 * d @ total[:q, -1] + d @ total[:q, :q] @ d)
        deviation = float(np.sqrt(max(square, 1e-12) / max(count - q + choice.has_clock, 1)))
        share = self._share(_left(moments) / count)
        units = np.ones(len(total))
        units[:q] = units[-1] = 1.0 / deviation
        scaled = Moments(moments.blocks * np.outer(units, units), q)
        return Posterior.of(scaled, Reduced.of(scaled.total, q), self.families, share, count, sizes)

    def _share(self, left: float) -> float:
        """Return the effective share of rows whose mean square is ``left``: the memory lies between known models'."""
        known = self.memory[np.argsort(self.memory[:, 0], kind="stable")]
        products = np.array([np.interp(left, known[:, 0], column) for column in known.T])
        return share_of(products[1:] / max(products[0], 1e-300), self.count)

    def parts(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays that a file keeps.

        The scores (J, F)'y of each block in single precision, their other products in half, the sum of all in full.
        """
        total = self.moments.total
        width = len(total)
        size = np.sqrt(np.maximum(np.diag(total), 1e-300))
        scaled = self.moments.blocks / np.outer(size, size)
        upper = np.triu_indices(width)
        figures = [self.softening, self.families.unseen, self.count, self.moved, self.moments.known]
        return {
            "locked_total": total[upper],
            "locked_blocks": scaled[:, upper[0], upper[1]].astype(np.float16),
            "locked_scores": scaled[:, :, -1].astype(np.float32),
            "locked_places": np.stack([self.places, self.folds]).astype(np.int32),
            "locked_own": self.own.astype(np.int16),
            "locked_terms": self.families.of_terms.astype(np.int8),
            "locked_slopes": self.slopes,
            "locked_matrix": self.matrix,
            "locked_move": self.move,
            "locked_memory": self.memory,
            "locked_figures": np.array(figures, np.float64),
            "locked_names": np.frombuffer(",".join(self.families.names).encode(), np.uint8),
        }

    @classmethod
    def of_parts(cls, part: Parts) -> LockedSums | None:
        """Return the sums of a file; None where it has none. What half precision lost of the sum is shared out."""
        if "locked_total" not in part:
            return None
        softening, unseen, count, moved, known = part["locked_figures"].tolist()
        width = int(known) + len(part["locked_terms"]) + 1
        total = _symmetric(part["locked_total"][None], width)[0]
        size = np.sqrt(np.maximum(np.diag(total), 1e-300))
        blocks = _symmetric(part["locked_blocks"].astype(np.float64), width)
        blocks[:, :, -1] = blocks[:, -1, :] = part["locked_scores"]
        blocks *= np.outer(size, size)
        blocks += (total - blocks.sum(axis=0)) / len(blocks)
        names = part["locked_names"].tobytes().decode()
        families = LockedFamilies(
            tuple(names.split(",")) if names else (), part["locked_terms"].astype(np.intp), unseen
        )
        return cls(
            moments=Moments(blocks, int(known)),
            places=part["locked_places"][0].astype(np.intp),
            folds=part["locked_places"][1].astype(np.intp),
            families=families,
            slopes=part["locked_slopes"],
            matrix=part["locked_matrix"],
            memory=part["locked_memory"],
            count=int(count),
            softening=softening,
            own=part["locked_own"].astype(np.intp),
            moved=bool(moved),
            move=part["locked_move"],
        )


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceSums:
    """Products of (J, C) of rows that stand for all, C what each error of the reference does to the residual.

    Attributes
    ----------
    blocks : shape (b, q + m, q + m)
    firsts : shape (b,)
        First block of the fit's sums in each of them.
    sources : tuple of str
        Names of the m errors.
    mean, spread : shape (k,)
        Of the regressors over these rows.
    matrix : shape (3, 3)
        T at the fit.
    """

    blocks: Floats
    firsts: NDArray[np.intp]
    sources: tuple[str, ...]
    mean: Floats
    spread: Floats
    matrix: Floats

    def shifts(self, choice: Choice) -> Floats:
        """Return what each error does to the parameters of ``choice``, shape (m, p).

        Raises
        ------
        NotObservableError
            What is left of these rows does not determine the unknowns.
        """
        q = self.blocks.shape[1] - len(self.sources)
        total = np.tensordot(choice.shares_of(self.firsts), self.blocks, 1)
        normal = total[np.ix_(choice.take, choice.take)]
        if not is_positive_definite(normal):
            raise NotObservableError("what is left of the data does not determine the unknowns")
        moves = total[q:, choice.take] @ scaled_inverse(normal)
        if choice.has_clock:
            moves = moves[[name != LATE for name in self.sources]]
        return np.asarray(moves @ choice.to_parameters(self.matrix, self.mean, self.spread).T)

    def parts(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays that a file keeps."""
        width = self.blocks.shape[1]
        size = np.sqrt(np.maximum(np.diag(self.blocks.sum(axis=0)), 1e-300))
        upper = np.triu_indices(width)
        return {
            "reference_blocks": (self.blocks / np.outer(size, size))[:, upper[0], upper[1]].astype(np.float32),
            "reference_size": size,
            "reference_firsts": self.firsts.astype(np.int32),
            "reference_standard": np.stack([self.mean, self.spread]),
            "reference_matrix": self.matrix,
            "reference_sources": np.frombuffer(",".join(self.sources).encode(), np.uint8),
        }

    @classmethod
    def of_parts(cls, part: Parts) -> ReferenceSums | None:
        """Return the sums of a file; None where it has none."""
        if "reference_size" not in part:
            return None
        size = part["reference_size"]
        blocks = _symmetric(part["reference_blocks"].astype(np.float64), len(size)) * np.outer(size, size)
        mean, spread = part["reference_standard"]
        sources = tuple(part["reference_sources"].tobytes().decode().split(","))
        return cls(blocks, part["reference_firsts"].astype(np.intp), sources, mean, spread, part["reference_matrix"])


def _symmetric(upper: Floats, width: int) -> Floats:
    """Return matrices, shape (b, width, width), from their upper halves, shape (b, width (width + 1) / 2)."""
    at = np.triu_indices(width)
    full = np.empty((len(upper), width, width))
    full[:, at[0], at[1]] = upper
    full[:, at[1], at[0]] = upper
    return full


def _selected(moments: Moments, take: NDArray[np.intp], slopes: Floats) -> Moments:
    """Return the moments of the unknowns ``take`` where ``slopes``, shape (3 k,), of regressors are taken off."""
    q, width = moments.known, moments.blocks.shape[1]
    taken_off = np.eye(width)
    taken_off[9 : 9 + len(slopes), -1] = slopes
    blocks = taken_off.T @ moments.blocks @ taken_off if slopes.any() else moments.blocks
    kept = np.concatenate([take, np.arange(q, width)])
    return Moments(np.ascontiguousarray(blocks[:, kept[:, None], kept]), len(take))


def _least_squares(moments: Moments, clock_s: float | None) -> Floats:
    """Return the plain estimate, shape (q,), with the clock, which is the last of the unknowns, at ``clock_s``."""
    total, q = moments.total, moments.known - (clock_s is not None)
    right = total[:q, -1] if clock_s is None else total[:q, -1] - total[:q, q] * clock_s
    found = scaled_inverse(total[:q, :q]) @ right
    return found if clock_s is None else np.append(found, clock_s)


def _left(moments: Moments) -> float:
    """Return the sum of squares that all terms leave, each of the largest size."""
    total = moments.total
    both = _of_largest(total, moments.known)
    return max(float(total[-1, -1] - 2.0 * both @ total[:-1, -1] + both @ total[:-1, :-1] @ both), 0.0)


def _of_largest(total: Floats, known: int) -> Floats:
    """Return the unknowns and the terms, each of the largest size, that ``total`` leads to."""
    reduced = Reduced.of(total, known)
    a = largest_terms(reduced)
    return np.concatenate([reduced.offset - reduced.carry @ a, a])


def _memory(
    rows: Rows, columns: Floats, moments: Moments, choices: Sequence[tuple[NDArray[np.intp], Floats]]
) -> Floats:
    """Return the memory of `LockedSums` under each of ``choices``: the unknowns, and the slopes that are taken off."""
    made = []
    for take, slopes in choices:
        chosen = _selected(moments, take, slopes)
        found = _of_largest(chosen.total, chosen.known)
        d = np.zeros(moments.known)
        d[take] = found[: len(take)]
        d[9 : 9 + len(slopes)] -= slopes
        made.append(products_of(rows, columns, d, found[len(take) :]))
    lags = max(map(len, made))
    return np.array([np.append(one, np.zeros(lags - len(one))) for one in made]) / rows.count


def _with_slopes(parameters: Parameters, o: Observations) -> Parameters:
    """Return ``parameters`` with slopes of zero for the regressors of ``o`` that they lack, in the order of these."""
    none = np.zeros(3)
    return replace(parameters, regressors={name: parameters.regressors.get(name, none) for name in o.regressors})


def locked_sums(
    o: Observations, fit: Fit, terms: LockedTerms, starts: NDArray[np.intp], *, is_clock_fitted: bool
) -> LockedSums:
    """Return the sums about where ``terms`` left ``fit``.

    ``o``: with every regressor that may be asked for, and the fall of the reference by the clock; ``starts``: first
    samples of the blocks of the fit's sums.
    """
    wide = replace(fit, parameters=_with_slopes(replace(fit.parameters, time_offset_s=None), o))
    at = (terms.matrix, _with_slopes(replace(terms.parameters, time_offset_s=None), o))
    sigmas = [channel.sigma_nt for channel in rows_of(o, wide).channels]
    rows = rows_of(o, wide, sigmas_nt=sigmas, at=at)
    q, columns = rows.unknowns.size, terms.columns
    edges = starts_of(fit, BLOCKS)
    slopes = [
        slope * spread for slope, spread in zip(at[1].regressors.values(), rows.unknowns.drifts.spread, strict=True)
    ]
    move = np.zeros(q)
    # Those of the fit come first; a clock is the last, and no move of it is one of the estimate.
    inner = 9 + 3 * len(fit.parameters.regressors)
    if terms.moved:
        move[:inner] = terms.step[:inner]
    middles = (edges + np.append(edges[1:], len(o))) // 2
    made = rows.moments(columns.columns, edges)
    few, all_slopes = np.arange(9), np.concatenate([*slopes, np.zeros(0)])
    own = np.arange(inner)
    if is_clock_fitted:
        own = np.append(own, q - 1)
    choices = [(own, 0.0 * all_slopes), (few, all_slopes), (np.arange(q), 0.0 * all_slopes)]
    return LockedSums(
        moments=made,
        places=np.searchsorted(starts, edges, side="right") - 1,
        folds=np.searchsorted([fold.start for fold in folds_of(o.t_s)], middles, side="right") - 1,
        families=columns.locked_families,
        slopes=all_slopes,
        matrix=terms.matrix,
        memory=_memory(rows, columns.columns, made, choices),
        count=rows.count,
        softening=terms.softening,
        own=own,
        moved=terms.moved,
        move=move,
    )


def reference_sums(o: Observations, fit: Fit, errors: ReferenceErrors, starts: NDArray[np.intp]) -> ReferenceSums:
    """Return what ``errors`` do about ``fit``; ``o`` and ``starts`` as in `locked_sums`."""
    wide = replace(fit, parameters=_with_slopes(replace(fit.parameters, time_offset_s=None), o))
    linear, products = errors.products(o, wide, starts)
    firsts = np.arange(0, len(starts), -(-len(starts) // _REFERENCE_BLOCKS))
    drifts = linear.unknowns.drifts
    made = np.add.reduceat(products, firsts, axis=0)
    names = tuple(name for name, _ in errors.named)
    return ReferenceSums(made, firsts, names, drifts.mean, drifts.spread, linear.matrix)
