"""Which housekeeping columns move the bias: forward selection by cross-validation over contiguous blocks of time.

Notes
-----
A regressor that halves the residual may double the error on unseen data: only what lowers the held-out residual enters.
Blocks of one session share its drift, though: a column that has nothing to do with the sensor predicts a slow bias too.
So candidates are ranked by their evidence beside every smooth bias (`terms.regressor_evidence`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.normal_equations import Equations
from magcal_core.calibration.terms.regressor_evidence import ENOUGH as ENOUGH_EVIDENCE
from magcal_core.calibration.terms.regressor_evidence import ColumnEvidence, SmoothBias
from magcal_core.calibration.uncertainty.cross_validation import folds_of, held_out_residuals_nt, rms_nt
from magcal_core.observations import Observations
from magcal_core.sensor.regressors import source_of

MAX_TERMS: Final = 8
GAIN: Final = 0.02
"""Share by which the held-out residual must fall for a term to enter."""
ENOUGH: Final = 0.95
"""Share of the usable samples that a column must have a value for."""
_TRIED: Final = 3
"""Candidates that are held against their surrogates and refitted before the selection ends."""
_SAME: Final = 0.999
"""Correlation of two columns above which they say the same."""
_ALIKE: Final = 0.95
"""Correlation above which either of two columns serves: two sensors of one temperature."""
ABOVE_RIVALS: Final = 1.0
"""By how much the log evidence of a column must be above that of another which is none beside it."""


@dataclass(frozen=True, slots=True)
class Ablation:
    """One model that was tried: its terms, its residual in the fit and on unseen blocks, nT, its cost, nT^2.

    ``evidence``: of its last term beside every smooth bias, where that was weighed; ``gains``: unseen blocks bear that
    term out.
    """

    regressors: tuple[str, ...]
    rms_nt: float
    cross_validated_rms_nt: float | None
    cost: float
    is_selected: bool = False
    evidence: ColumnEvidence | None = None
    gains: bool = False

    def to_dict(self) -> dict[str, object]:
        """Return the row as the records have it."""
        return {
            "name": " + ".join(["9 parameters", *self.regressors]),
            "regressors": list(self.regressors),
            "parameters": 9 + 3 * len(self.regressors),
            "rms_nt": self.rms_nt,
            "cross_validated_rms_nt": self.cross_validated_rms_nt,
            "cost": self.cost,
            "selected": self.is_selected,
            "log_evidence": None if self.evidence is None else self.evidence.log_evidence,
            "surrogate_max": None if self.evidence is None else self.evidence.surrogate_max,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The terms chosen, and every model that was tried on the way."""

    names: tuple[str, ...]
    ablation: tuple[Ablation, ...]


def untold_terms(ablation: Sequence[Ablation], taken: Sequence[str]) -> tuple[Ablation, ...]:
    """Return the models whose last term gains on unseen blocks and is not among the terms ``taken``, one a column.

    Such a term may be real: one session cannot tell it from a slow change of the bias, another one can.
    """
    known = {source_of(name) for name in taken}
    found: dict[str, Ablation] = {}
    for row in ablation:
        if row.gains and row.regressors and source_of(row.regressors[-1]) not in known:
            found.setdefault(source_of(row.regressors[-1]), row)
    return tuple(found.values())


def usable_columns(housekeeping: Mapping[str, Floats], usable: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the columns that are not constant and have a value for `ENOUGH` of the usable samples, shape (n,)."""
    names = []
    for name, column in housekeeping.items():
        values = np.asarray(column, dtype=np.float64)[usable]
        finite = values[np.isfinite(values)]
        if finite.size and finite.size >= ENOUGH * values.size and np.ptp(finite) > 0:
            names.append(name)
    return tuple(names)


def ablation_of(
    estimator: Estimator, observations: Observations, settings: FitSettings, models: Sequence[tuple[str, ...]]
) -> tuple[Ablation, ...]:
    """Return what each of ``models`` leaves, in the fit and on unseen blocks; the last one is the selected one."""
    rows = [_trial(estimator, observations, settings, names)[0] for names in models]
    return (*rows[:-1], replace(rows[-1], is_selected=True))


def choose_regressors(
    estimator: Estimator, observations: Observations, settings: FitSettings, smooth: SmoothBias
) -> Choice:
    """Return the terms, among the regressors of ``observations``, that bear evidence beside every smooth bias.

    ``smooth``: what a column must bear evidence beside. Starts from none and adds the one with the most evidence while
    that is enough, more than any of its surrogates', and unseen blocks support it: the held-out residual falls by
    `GAIN`, and in most of the blocks. Where another column explains the same nearly as well, one session does not tell
    which of them it is, and neither is taken. Without any such term, or where the blocks alone do not determine the
    parameters, the choice is none.
    """
    row, fit, held_out = _trial(estimator, observations, settings, ())
    rows = [row]
    while held_out is not None and len(row.regressors) < MAX_TERMS:
        present = observations.with_regressors(row.regressors)
        weighed = _weighed(smooth, observations, present, fit)
        for name, evidence in _ranked(smooth, observations, present, fit, weighed):
            more = (*row.regressors, name)
            tried, tried_fit, tried_held_out = _trial(estimator, observations, replace(settings, near=fit), more)
            is_better = tried_held_out is not None and _is_better(observations, fit, held_out, tried_held_out)
            rows.append(replace(tried, evidence=evidence, gains=is_better))
            rivals = _rivals(observations, name, weighed)
            if evidence.is_enough and is_better and _are_real_beside(smooth, observations, more, tried_fit, rivals):
                row, fit, held_out = rows[-1], tried_fit, tried_held_out
                break
        else:
            break
    rows[rows.index(row)] = replace(row, is_selected=True)
    return Choice(row.regressors, tuple(rows))


def _weighed(smooth: SmoothBias, observations: Observations, present: Observations, fit: Fit) -> Mapping[str, float]:
    """Return the log evidence of every candidate, of each column at the lag with the most, the largest first.

    A slow column is nearly the same at all lags, and they would be all that is tried.
    """
    chosen = tuple(present.regressors)
    candidates = {
        name: [column]
        for name, column in observations.regressors.items()
        if name not in chosen and not _repeats(observations, name, chosen)
    }
    found = smooth.weigh(present, fit, candidates)
    of_each: dict[str, str] = {}
    for name in sorted(found, key=lambda one: -found[one]):
        of_each.setdefault(source_of(name), name)
    return {name: found[name] for name in of_each.values()}


def _ranked(
    smooth: SmoothBias, observations: Observations, present: Observations, fit: Fit, weighed: Mapping[str, float]
) -> list[tuple[str, ColumnEvidence]]:
    """Return the candidates with the most evidence, the best first: all with enough, or else the best alone."""
    ranked = list(weighed)
    enough = [name for name in ranked if weighed[name] >= ENOUGH_EVIDENCE][:_TRIED]
    if not enough:
        return [(name, ColumnEvidence(weighed[name])) for name in ranked[:1]]
    columns = observations.regressors
    return [(name, smooth.against_surrogates(present, fit, [columns[name]], weighed[name])) for name in enough]


def _rivals(observations: Observations, name: str, weighed: Mapping[str, float]) -> list[str]:
    """Return the columns with more evidence than ``name``, which were not taken, and those with about as much.

    Of these not what is much like it: either serves.
    """
    columns, own = observations.regressors, weighed[name]
    return [
        one
        for one, log in weighed.items()
        if log > own
        or (one != name and log > own - ABOVE_RIVALS and abs(np.corrcoef(columns[name], columns[one])[0, 1]) < _ALIKE)
    ]


def _are_real_beside(
    smooth: SmoothBias, observations: Observations, more: tuple[str, ...], fit: Fit, rivals: Sequence[str]
) -> bool:
    """Return whether the rivals of the last of the terms ``more`` bear evidence beside it, of other things."""
    if not rivals:
        return True
    candidates = {name: [observations.regressors[name]] for name in rivals}
    found = smooth.weigh(observations.with_regressors(more), fit, candidates)
    return all(found.get(name, 0.0) >= ENOUGH_EVIDENCE for name in rivals)


def _trial(
    estimator: Estimator, observations: Observations, settings: FitSettings, names: tuple[str, ...]
) -> tuple[Ablation, Fit, Floats | None]:
    chosen = observations.with_regressors(names)
    fit = estimator.fit(chosen, settings)
    held_out = held_out_residuals_nt(estimator, chosen, settings, fit)
    unseen = None if held_out is None else rms_nt(held_out, fit.weights)
    return Ablation(names, rms_nt(fit.residuals_nt, fit.weights), unseen, fit.cost), fit, held_out


def _is_better(observations: Observations, fit: Fit, held_out: Floats, tried: Floats) -> bool:
    used, folds = fit.weights > 0, folds_of(observations.t_s)
    before, after = (
        np.array([np.sum(unseen[fold][used[fold]] ** 2) for fold in folds]) for unseen in (held_out, tried)
    )
    return is_borne_out(before, after)


def is_borne_out(before: Floats, after: Floats) -> bool:
    """Return whether unseen blocks bear a further term out, by their sums of squares without it and with it, (m,).

    The residual falls by `GAIN`, and in most of the blocks that have any.
    """
    has_data = before > 0
    return bool(
        after.sum() < (1.0 - GAIN) ** 2 * before.sum()
        and 2 * np.count_nonzero(after[has_data] < before[has_data]) > np.count_nonzero(has_data)
    )


def _repeats(observations: Observations, name: str, chosen: Sequence[str]) -> bool:
    column = observations.regressors[name]
    if np.ptp(column) == 0:
        return True
    return any(abs(np.corrcoef(column, observations.regressors[other])[0, 1]) > _SAME for other in chosen)


def held_out_cost(folds: Sequence[Equations], take: NDArray[np.intp]) -> Floats:
    """Return each block's cost, shape (m,), one Gauss-Newton step of the unknowns ``take`` on from the other blocks.

    Infinite, all of them, where the others do not determine the step.
    """
    normals = [fold.normal[np.ix_(take, take)] for fold in folds]
    gradients = [fold.gradient[take] for fold in folds]
    normal, gradient = sum(normals[1:], normals[0]), sum(gradients[1:], gradients[0])
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    costs = np.empty(len(folds))
    for i, (fold, own, slope) in enumerate(zip(folds, normals, gradients, strict=True)):
        rest = (normal - own) / np.outer(size, size)
        rest[np.diag_indices_from(rest)] += 1e-9
        try:
            step = -np.linalg.solve(rest, (gradient - slope) / size) / size
        except np.linalg.LinAlgError:
            return np.full(len(folds), np.inf)
        costs[i] = fold.cost + 2.0 * float(slope @ step) + float(step @ own @ step)
    return costs
