"""Refits from the moments of a fit: other regressors, the clock, spans left out, bootstrap, without a single sample.

Notes
-----
Each is one Gauss-Newton step from the fit, under the weights that the fit gave the samples: exact where the residual is
linear in the unknowns, and near the fit it hardly bends. Under a robust loss the weights would change with the step:
for a small one as the loss bends, which is known; the more of the residuals it takes, the less of that is believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.normal_equations import Equations
from magcal_core.calibration.refit.block_sums import BlockSums
from magcal_core.calibration.refit.moments import FitMoments
from magcal_core.calibration.refit.outcome import ParameterChange, Refit, RefitOptions
from magcal_core.calibration.terms.clock import ClockTest
from magcal_core.calibration.terms.regressor_selection import MAX_TERMS, Ablation, held_out_cost, is_borne_out
from magcal_core.calibration.uncertainty.bootstrap import Bootstrap, drawn
from magcal_core.calibration.uncertainty.cross_validation import FOLDS
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance, honest_covariance
from magcal_core.calibration.uncertainty.reweighted_blocks import steps_of
from magcal_core.errors import NotObservableError, OptionError
from magcal_core.numerics.blocks import BlockScores
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.sensor.parameters import Parameters
from magcal_core.telemetry.spans import Span

HIDDEN_ERRORS: Final = (
    "hidden_errors_not_kept: the moments are from before they had errors locked to the orbit and errors of the "
    "reference; where this refit is not the set, its errors may be too small: calibrate again"
)
"""Warning of a refit from moments of the old form."""
LEAST_SHARE: Final = 0.1
"""Share of the data that spans of time must leave."""


def refit(moments: FitMoments, options: RefitOptions) -> Refit:
    """Return the refit that ``options`` ask for.

    Raises
    ------
    OptionError
        A column or the clock is not among the moments, or the spans leave too little.
    NotObservableError
        The blocks that are left do not determine the unknowns.
    """
    shares = _shares(moments, options.without)
    left_out = 1.0 - float(moments.weights @ shares) / float(moments.weights.sum())
    has_clock = _has_clock(moments, options)
    chosen = moments.fitted if options.regressors is None else options.regressors
    problem = _Problem(moments, moments.cut(shares), shares, has_clock)
    if chosen == "auto":
        names, ablation = _chosen(problem)
    else:
        problem.require(chosen)
        names = tuple(dict.fromkeys(chosen))
        ablation = tuple(problem.tried(one) for one in dict.fromkeys([(), names]))
    ablation = tuple(replace(row, is_selected=row.regressors == names) for row in ablation)
    found = _refit(problem, names, ablation, left_out, options)
    found = found if not moments.trusted.size else _trusted(moments, found)
    return replace(found, warnings=_warnings(moments, found))


def _warnings(moments: FitMoments, found: Refit) -> tuple[str, ...]:
    """Return what the errors do not contain."""
    warnings = [HIDDEN_ERRORS] if moments.is_old else []
    if moments.clock_s and not moments.is_clock_fitted and found.time_offset is None:
        warnings.append(
            f"clock_held: the clock, found beside waves of the bias or with a drift, stays {moments.clock_s:.3g} s off "
            "as if it were known; what its own error does to the parameters is in the set's errors alone"
        )
    return tuple(warnings)


def _trusted(moments: FitMoments, found: Refit) -> Refit:
    """Return the refit about the calibration: what a refit of nothing else lacks of it is added to every parameter.

    Notes
    -----
    And what the errors of a refit of nothing else are too small by multiplies every error, so that such a refit *is*
    the calibration: one of several steps, with blocks cut finer than the moments have them.
    """
    base = _nothing_else(moments)
    values, errors = moments.trusted
    names = base.parameters.names[: len(values)]
    known, small = base.parameters.vector[: len(values)], base.standard_errors.vector
    shift = dict(zip(names, values - known, strict=True))
    wider = dict(zip(names, errors[: len(small)] / np.maximum(small, 1e-300), strict=False))
    clock_error = None if found.time_offset is None else found.time_offset.error_s
    if base.time_offset is not None:
        wider["time_offset_s"] = float(errors[-1]) / max(base.time_offset.error_s, 1e-300)
    moved = np.array([shift.get(name, 0.0) for name in found.parameters.names])
    parameters = found.parameters.with_vector(found.parameters.vector + moved)
    factor = np.array([wider.get(name, 1.0) for name in found.standard_errors.names])
    standard_errors = found.standard_errors.with_vector(found.standard_errors.vector * factor)
    before = dict(zip(names, values.tolist(), strict=True))
    changes = tuple(
        replace(
            one,
            before=before.get(one.parameter, one.before),
            after=one.after + shift.get(one.parameter, 0.0) if one.parameter in parameters.names else one.after,
            standard_error=one.standard_error * wider.get(one.parameter, 1.0),
        )
        for one in found.changes
    )
    clock = found.time_offset
    if clock is not None and clock_error is not None:
        moved_s = clock.offset_s + shift.get("time_offset_s", 0.0)
        clock = ClockTest(moved_s, clock_error * wider.get("time_offset_s", 1.0))
    return replace(found, parameters=parameters, standard_errors=standard_errors, changes=changes, time_offset=clock)


@lru_cache(maxsize=8)
def _nothing_else(moments: FitMoments) -> Refit:
    """Return the refit of nothing else; whoever asks for one mostly asks for others."""
    problem = _Problem(moments, moments.sums, np.ones(len(moments.weights)), moments.is_clock_fitted)
    ablation = (replace(problem.tried(moments.fitted), is_selected=True),)
    return _refit(problem, moments.fitted, ablation, 0.0, RefitOptions())


def _shares(moments: FitMoments, without: Sequence[Span]) -> Floats:
    """Return the share of time of each of the fit's own blocks that lies in none of the spans, shape (b,)."""
    begins, ends = moments.own_begins, moments.own_ends
    length = np.maximum((ends - begins) / np.timedelta64(1, "ns"), 1.0)
    inside = np.zeros(len(begins))
    for begin, end in _apart(without):
        overlap = np.minimum(ends, end) - np.maximum(begins, begin)
        inside += np.maximum(overlap / np.timedelta64(1, "ns"), 0.0) / length
    shares = np.clip(1.0 - inside, 0.0, 1.0)
    if float(moments.weights @ shares) < LEAST_SHARE * float(moments.weights.sum()):
        raise OptionError(f"without: the spans leave less than {LEAST_SHARE:.0%} of the data")
    return np.asarray(shares)


def _apart(spans: Sequence[Span]) -> list[Span]:
    """Return the spans in order, those that overlap as one."""
    apart: list[Span] = []
    for begin, end in sorted(spans):
        if not begin < end:
            raise OptionError("without: a span of time ends before it begins")
        if apart and begin <= apart[-1][1]:
            apart[-1] = (apart[-1][0], max(apart[-1][1], end))
        else:
            apart.append((begin, end))
    return apart


def _has_clock(moments: FitMoments, options: RefitOptions) -> bool:
    if options.time_offset and not moments.has_clock:
        raise OptionError(
            "time_offset: the moments have no clock: the reference came with the telemetry, or its orbit ends with it"
        )
    return moments.is_clock_fitted if options.time_offset is None else options.time_offset


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The moments with ``shares`` of the fit's own blocks, shape (b,), in ``sums``; whether the clock is an unknown."""

    moments: FitMoments
    sums: BlockSums
    shares: Floats
    has_clock: bool

    @property
    def counted(self) -> Floats:
        """How much each block of the sums counts, shape (m,)."""
        return self.moments.shares_of_sums(self.shares)

    def require(self, names: Sequence[str]) -> None:
        """Refuse names of columns that the moments do not have."""
        columns = self.moments.columns
        missing = [name for name in names if name not in columns]
        if missing:
            known = ", ".join(columns) if columns else "none"
            raise OptionError(f"regressors: the moments have no column {missing[0]!r}; there are {known}")

    def unknowns(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Return where the unknowns stand that a model with these regressors has."""
        return self.moments.unknowns(names, has_clock=self.has_clock)

    def removal(self, names: Sequence[str]) -> Floats:
        """Return the step that takes the slopes of all other regressors to zero."""
        step = np.zeros(self.moments.own.size)
        for j, name in enumerate(self.moments.columns):
            if name not in names:
                step[9 + 3 * j : 12 + 3 * j] = -self.moments.own[9 + 3 * j : 12 + 3 * j]
        return step

    def based(self, names: Sequence[str]) -> BlockSums:
        """Return the sums where all other regressors are zero."""
        return self.sums.moved(self.removal(names))

    def folds(self, base: BlockSums) -> list[Equations]:
        """Return the sums over contiguous spans of time, equally long; those without data are dropped."""
        begins, ends = self.moments.begins, self.moments.ends
        middle = begins + (ends - begins) // 2
        span = max(float((ends[-1] - begins[0]) / np.timedelta64(1, "ns")), 1.0)
        fold = np.minimum(FOLDS * ((middle - begins[0]) / np.timedelta64(1, "ns")) / span, FOLDS - 1).astype(np.intp)
        found = []
        for i in range(FOLDS):
            of = fold == i
            if base.weights[of].sum() > 0:
                found.append(Equations(base.normals[of].sum(0), base.scores[of].sum(0), float(base.costs[of].sum())))
        return found

    def tried(self, names: tuple[str, ...]) -> Ablation:
        """Return what a model leaves, in the refit and on unseen blocks."""
        base, take = self.based(names), self.unknowns(names)
        weight = float(base.weights.sum())
        held_out = float(np.sum(held_out_cost(self.folds(base), take)))
        step = _solved(base, take)
        cost = float(base.moved(step).costs.sum())
        unseen = float(np.sqrt(max(held_out, 0.0) / weight)) if np.isfinite(held_out) else None
        return Ablation(names, float(np.sqrt(cost / weight)), unseen, cost)


def _solved(base: BlockSums, take: NDArray[np.intp]) -> Floats:
    """Return the step, among all unknowns, that takes those at ``take`` to the minimum."""
    steps = steps_of(base.scores[:, take], base.normals[:, take[:, None], take], np.ones((1, len(base.costs))))
    if not np.isfinite(steps).all():
        raise NotObservableError("what is left of the data does not determine the unknowns")
    step = np.zeros(base.scores.shape[1])
    step[take] = steps[0]
    return step


def _chosen(problem: _Problem) -> tuple[tuple[str, ...], tuple[Ablation, ...]]:
    """Return the regressors that unseen blocks support, one after the other, and every model that was tried."""
    names: tuple[str, ...] = ()
    rows = [problem.tried(names)]
    while len(names) < MAX_TERMS:
        folds = problem.folds(problem.based(()))
        costs = partial(held_out_cost, folds)
        before = costs(problem.unknowns(names))
        rest = [name for name in problem.moments.columns if name not in names]
        if not rest or not np.isfinite(before).all():
            break
        after = {name: costs(problem.unknowns((*names, name))) for name in rest}
        best = min(rest, key=lambda name: float(np.sum(after[name])))
        rows.append(problem.tried((*names, best)))
        if not is_borne_out(before, after[best]):
            break
        names = (*names, best)
    return names, tuple(rows)


def _refit(
    problem: _Problem, names: tuple[str, ...], ablation: tuple[Ablation, ...], left_out: float, options: RefitOptions
) -> Refit:
    moments, take = problem.moments, problem.unknowns(names)
    removal = problem.removal(names)
    step = _step(problem, names, _bent(problem, names).moved(removal), take)
    after, own = _bent(problem, names).moved(removal).moved(step), moments.own + removal + step
    blocks, honest, move = _errors(problem, names, after, own, left_out)
    parameters = moments.parameters(own, names)
    p = parameters.vector.size
    parameters = parameters.with_vector(parameters.vector + move[:p])
    errors = np.sqrt(np.diag(honest.covariance))
    resampled = None
    if options.bootstrap:
        resampled = _bootstrap(parameters, blocks, honest, problem, options)
    row = next(one for one in ablation if one.is_selected)
    before = moments.parameters(moments.own, moments.fitted)
    clock_s = moments.clock_s + (float(own[-1]) if problem.has_clock else 0.0)
    return Refit(
        parameters=replace(parameters, time_offset_s=clock_s) if clock_s else parameters,
        standard_errors=parameters.with_vector(errors[:p]),
        changes=_changes(before, parameters, errors),
        rms_nt=row.rms_nt,
        cross_validated_rms_nt=row.cross_validated_rms_nt,
        samples=round(moments.samples * (1.0 - left_out)),
        blocks=honest.blocks,
        left_out_share=left_out,
        ablation=ablation,
        time_offset=ClockTest(clock_s, float(errors[-1])) if problem.has_clock else None,
        bootstrap=resampled,
    )


def _step(problem: _Problem, names: Sequence[str], base: BlockSums, take: NDArray[np.intp]) -> Floats:
    """Return the step to the estimate; a clock goes where locked errors leave it, the rest to the minimum there."""
    locked = problem.moments.locked
    if locked is None or not problem.has_clock:
        return _solved(base, take)
    step = np.zeros(problem.moments.own.size)
    step[-1] = locked.clock_step_s(problem.moments.choice(names, problem.counted, has_clock=True))
    return step + _solved(base.moved(step), take[:-1])


def _errors(
    problem: _Problem, names: Sequence[str], after: BlockSums, own: Floats, left_out: float
) -> tuple[BlockScores, HonestCovariance, Floats]:
    """Return the blocks at the refit, its covariance beside hidden errors, and how far locked ones move it."""
    moments = problem.moments
    take = problem.unknowns(names)
    blocks, honest = _honest(problem, after, own, take, left_out)
    choice = moments.choice(names, problem.counted, has_clock=problem.has_clock)
    covariance, move = honest.covariance, np.zeros(len(take))
    if moments.locked is not None:
        locked = moments.locked.errors(choice, moments.duration_s * (1.0 - left_out))
        covariance, move = locked.covariance, locked.move
    if moments.reference is not None:
        shifts = moments.reference.shifts(choice)
    else:
        shifts = moments.shifts[:, take] @ moments.to_parameters(own)[np.ix_(take, take)].T
    return blocks, replace(honest, covariance=covariance + shifts.T @ shifts), move


def _bent(problem: _Problem, names: Sequence[str]) -> BlockSums:
    """Return the sums with normal matrices as the loss bends them, the less so the more a refit changes the cost."""
    base = problem.based(names)
    costs = [float(problem.sums.costs.sum()), float(base.moved(_solved(base, problem.unknowns(names))).costs.sum())]
    kept, softened = min(costs) / max(*costs, 1e-300), problem.moments.softened
    return replace(problem.sums, normals=(softened * kept + 1.0 - kept) * problem.sums.normals)


def _honest(
    problem: _Problem, after: BlockSums, own: Floats, take: NDArray[np.intp], left_out: float
) -> tuple[BlockScores, HonestCovariance]:
    """Return scores and normal matrices of the blocks that count, at the refit, and the covariance that they show."""
    moments, of = problem.moments, problem.moments.of
    jacobian = moments.to_parameters(own)[np.ix_(take, take)]
    # A block of the fit has its share, by weight, of its neighbours' normal matrix and of what the step did to them.
    left = moments.weights * problem.shares
    share = left / np.maximum(problem.sums.weights[of], 1e-300)
    moved = (after.scores - problem.sums.scores)[:, take]
    counts = left > 0
    scores = (problem.shares[:, None] * moments.scores[:, take] + share[:, None] * moved[of])[counts]
    shared = problem.sums.normals[:, take[:, None], take][of[counts]]
    normals = (moments.softened * share[counts])[:, None, None] * shared
    before = moments.sums
    ratio = float(after.costs.sum() / after.weights.sum()) / float(before.costs.sum() / before.weights.sum())
    formal = ratio * moments.noise * jacobian @ scaled_inverse(normals.sum(axis=0)) @ jacobian.T
    blocks = BlockScores(scores, normals, np.arange(int(counts.sum())), jacobian)
    samples = round(moments.samples * (1.0 - left_out))
    return blocks, honest_covariance(blocks, formal, samples, moments.duration_s * (1.0 - left_out))


def _changes(before: Parameters, after: Parameters, errors: Floats) -> tuple[ParameterChange, ...]:
    """Return every parameter that either has, before and after; a regressor that one lacks is zero there."""
    known = dict(zip(before.names, before.vector.tolist(), strict=True))
    now = dict(zip(after.names, after.vector.tolist(), strict=True))
    error = dict(zip(after.names, errors.tolist(), strict=False))
    return tuple(
        ParameterChange(name, known.get(name, 0.0), now.get(name, 0.0), error.get(name, 0.0))
        for name in dict.fromkeys([*known, *now])
    )


def _bootstrap(
    parameters: Parameters, blocks: BlockScores, honest: HonestCovariance, problem: _Problem, options: RefitOptions
) -> Bootstrap:
    """Return the scatter of refits to blocks drawn with replacement, as many in a row as remember each other."""
    cells, samples = len(blocks.starts), problem.moments.samples
    in_a_row = max(1, round(honest.block_samples * cells / samples))
    counts = drawn(cells, in_a_row, options.bootstrap, np.random.default_rng(options.seed))
    steps = steps_of(blocks.scores, blocks.normals, counts)
    is_determined = np.isfinite(steps).all(axis=1)
    failed = int(np.count_nonzero(~is_determined))
    p = parameters.vector.size
    if failed == options.bootstrap:
        raise NotObservableError(f"bootstrap: none of {failed} replicates determines the parameters")
    values = parameters.vector + (steps[is_determined] @ blocks.to_parameters.T)[:, :p]
    return Bootstrap.of(parameters, values, failed, max(1, round(samples * in_a_row / cells)))
