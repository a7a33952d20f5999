"""Errors locked to the orbit, kept with a fit's moments so that a refit's errors know of them.

Notes
-----
A calibration widens its errors by them. A refit has other unknowns, and the same hidden errors do something else to
them: so not the widening is kept but what it is made from, the products of the rows' derivatives J by *every* unknown
that a refit may ask for with the locked terms F and the residual y. The posterior under another choice of unknowns is
then a selection of rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Moments, Rows, rows_of
from magcal_core.calibration.refit.choice import Choice, Parts, symmetric, with_slopes
from magcal_core.calibration.refit.split_moments import SplitMoments
from magcal_core.calibration.terms.evidence import SIZES, Reduced
from magcal_core.calibration.terms.locked import BETTER, BLOCKS, FEW_SIZES, MOVE_ERROR, LockedTerms, starts_of
from magcal_core.calibration.terms.locked_posterior import LockedFamilies, Posterior
from magcal_core.calibration.terms.locked_rows import largest_terms, products_of, share_of
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.numerics.linear_algebra import is_positive_definite, scaled_inverse
from magcal_core.observations import Observations

_ROUNDS: Final = 2


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
    moments : SplitMoments
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
    memory : shape (3, 1 + lags)
        Mean square of what all terms leave of a row, and its correlation with what they leave of the rows before: under
        the unknowns of the calibration, under the fewest and under the most.
    count, softening : int, float
        Number of rows, and what the loss divides their normal matrix by.
    own : shape (p,)
        Unknowns of the calibration.
    moved : bool
        Whether it moved to the posterior mean, by ``move``, shape (q,).
    """

    moments: SplitMoments
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
        chosen, step_s = self._chosen(choice), 0.0
        for _ in range(_ROUNDS):
            found = self._posterior(choice, chosen, chosen.least_squares(step_s), FEW_SIZES)
            step_s = float(found.reduced.offset[-1] + found.mixture.step[-1])
        return step_s

    def errors(self, choice: Choice, duration_s: float) -> LockedErrors:
        """Return what locked errors do to ``choice``; ``duration_s``: time that the samples left cover, s."""
        chosen = self._chosen(choice)
        estimate = chosen.least_squares(self.clock_step_s(choice) if choice.has_clock else None)
        found = self._posterior(choice, chosen, estimate, SIZES)
        is_moved = self._moves(choice, found)
        mixture, about = found.mixture, estimate - found.reduced.offset
        spread = mixture.covariance(None if is_moved else about)
        move = mixture.step - about if is_moved else np.zeros(len(about))
        more = MOVE_ERROR**2 * np.outer(move, move) + found.unseen_sun()[1]
        own = choice.to_parameters(self.matrix, choice.columns.mean, choice.columns.spread)
        in_parameters = own @ spread @ own.T
        blocks = np.arange(len(chosen.blocks))
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

    def _chosen(self, choice: Choice) -> SplitMoments:
        """Return the moments of the unknowns chosen, with the slopes of all other regressors at zero."""
        is_off = np.repeat([name not in choice.names for name in choice.columns.names], 3)
        slopes = np.where(is_off, self.slopes, 0.0)
        return self.moments.chosen(choice.take, slopes, choice.shares[self.places])

    def _posterior(self, choice: Choice, chosen: SplitMoments, estimate: Floats, sizes: tuple[float, ...]) -> Posterior:
        """Return the posterior of the moments ``chosen`` over ``sizes``, with the rows over what ``estimate`` leaves.

        The sizes of terms are in these deviations.
        """
        left = float(choice.weights @ choice.shares / choice.weights.sum())
        count = max(round(self.count * left), chosen.known + 1)
        share = self._share(_left(chosen.together()) / count)
        moments = chosen.together(chosen.deviations(estimate, count // chosen.channels))
        return Posterior.of(moments, Reduced.of(moments.total, moments.known), self.families, share, count, sizes)

    def _share(self, left: float) -> float:
        """Return the effective share of rows whose mean square is ``left``: their memory is between known models'."""
        known = self.memory[np.argsort(self.memory[:, 0], kind="stable")]
        return share_of(np.array([np.interp(left, known[:, 0], one) for one in known[:, 1:].T]), self.count)

    def parts(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays that a file keeps.

        The scores (J, F)'y of each block in single precision, their other products in half, the sum of all in full.
        """
        total = self.moments.total
        width = len(total)
        size = np.sqrt(np.maximum(np.diag(total), 1e-300))
        scaled = self.moments.blocks / np.outer(size, size)
        upper = np.triu_indices(width)
        split = self.moments
        figures = [self.softening, self.families.unseen, self.count, self.moved, split.has_clock, split.channels]
        return {
            "locked_total": total[upper],
            "locked_blocks": scaled[:, upper[0], upper[1]].astype(np.float16),
            "locked_scores": scaled[:, :, -split.channels :].astype(np.float32),
            "locked_axes": split.axes.astype(np.int8),
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
        softening, unseen, count, moved, has_clock, channels = part["locked_figures"].tolist()
        m, axes = int(channels), part["locked_axes"].astype(np.intp)
        width = len(axes) + m * int(has_clock) + len(part["locked_terms"]) + m
        total = symmetric(part["locked_total"][None], width)[0]
        size = np.sqrt(np.maximum(np.diag(total), 1e-300))
        blocks = symmetric(part["locked_blocks"].astype(np.float64), width)
        blocks[:, :, -m:] = part["locked_scores"]
        blocks[:, -m:, :] = blocks[:, :, -m:].swapaxes(1, 2)
        blocks *= np.outer(size, size)
        blocks += (total - blocks.sum(axis=0)) / len(blocks)
        names = part["locked_names"].tobytes().decode()
        families = LockedFamilies(
            tuple(names.split(",")) if names else (), part["locked_terms"].astype(np.intp), unseen
        )
        return cls(
            moments=SplitMoments(blocks, axes, bool(has_clock), m),
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
    rows: Rows, columns: Floats, moments: SplitMoments, choices: Sequence[tuple[NDArray[np.intp], Floats]]
) -> Floats:
    """Return the memory of `LockedSums` under each of ``choices``: the unknowns, and the slopes that are taken off."""
    made, whole = [], moments.as_one_block()
    for take, slopes in choices:
        chosen = whole.chosen(take, slopes, np.ones(1))
        plain = chosen.together()
        estimate = plain.total[: plain.known, : plain.known], plain.total[: plain.known, -1]
        over = chosen.deviations(scaled_inverse(estimate[0]) @ estimate[1], rows.count // moments.channels)
        found = _of_largest(chosen.together(over).total, chosen.known)
        d = np.zeros(moments.known)
        d[take] = found[: len(take)]
        d[9 : 9 + len(slopes)] -= slopes
        # Terms are in deviations of what is left of their axis.
        a = found[len(take) :] * np.resize(over, len(found) - len(take))
        products = products_of(rows, columns, d, a, over)
        made.append(np.append(_left(plain) / rows.count, products[1:] / max(float(products[0]), 1e-300)))
    lags = max(map(len, made))
    return np.array([np.append(one, np.zeros(lags - len(one))) for one in made])


def locked_sums(
    o: Observations, fit: Fit, terms: LockedTerms, starts: NDArray[np.intp], *, is_clock_fitted: bool
) -> LockedSums:
    """Return the sums about where ``terms`` left ``fit``.

    ``o``: with every regressor that may be asked for, and the fall of the reference by the clock; ``starts``: first
    samples of the blocks of the fit's sums.
    """
    wide = replace(fit, parameters=with_slopes(replace(fit.parameters, time_offset_s=None), o))
    at = (terms.matrix, with_slopes(replace(terms.parameters, time_offset_s=None), o))
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
    made = SplitMoments.of(rows, columns.columns, edges)
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
