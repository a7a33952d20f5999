"""Step 7, regressors: the columns that were asked for by name, or those that the data support."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.robust_start import scale_of
from magcal_core.calibration.observability.information import SIGMA_FLOOR, WEAK_BELOW
from magcal_core.calibration.terms.regressor_candidates import (
    LAGS,
    RESPONSES,
    FieldBeside,
    RegressorCandidate,
    offered_columns,
    regressor_candidates,
    triples,
)
from magcal_core.calibration.terms.regressor_evidence import SmoothBias
from magcal_core.calibration.terms.regressor_selection import Ablation, ablation_of, choose_regressors
from magcal_core.calibration.uncertainty.cross_validation import folds_of, held_out_residuals_nt
from magcal_core.errors import EstimationError
from magcal_core.estimation.clock import with_clock
from magcal_core.estimation.estimate import Estimate, Prepared, still
from magcal_core.estimation.inertial_field import inertial_field_nt
from magcal_core.estimation.start_and_loss import started
from magcal_core.observations import Observations, corrected_nt
from magcal_core.sensor.regressors import lag_of, lagged_name, response_of, source_of

LAG_GAIN: Final = 0.01
"""Share by which a lag must lower the held-out residual below that of lag 0, in most blocks."""
TERM_GAIN: Final = 0.02
"""Share by which a response, or the rest of a triple, must lower it."""
INDEX_KEPT: Final = 0.5
"""Share of the observability index that must be left once a term is projected out, where that is not good by itself."""
LEAST_INDEX: Final = 3.0
_MOST: Final = 3000
"""Samples that the index is taken from, at most about."""


def with_regressors(estimate: Estimate) -> Estimate:
    """Return the estimate with the regressors that the options ask for or the data support, and what was tried.

    Raises
    ------
    EstimationError
        The samples do not determine the sensor beside the regressors.
    """
    prepared = estimate.prepared
    if prepared.names:
        at = still(estimate.observations)
        tried = ablation_of(prepared.estimator, at, estimate.settings, [(), prepared.names])
        return replace(estimate, ablation=tried, candidates=_named_candidates(prepared))
    if prepared.options.regressors != "auto" or not prepared.estimator.takes_regressors:
        return estimate
    candidates = candidates_of(prepared, tuple(prepared.referenced.samples.housekeeping))
    at = still(estimate.observations)
    t_s = at.t_s
    columns = {
        name: np.asarray(column, np.float64)[prepared.usable]
        for name, column in prepared.referenced.samples.housekeeping.items()
    }
    offered = replace(at, regressors=offered_columns(columns, candidates, t_s))
    smooth = SmoothBias(prepared.session.columns(estimate.observations, estimate.fit), prepared.options.seed)
    choice = choose_regressors(prepared.estimator, offered, estimate.settings, smooth)
    settled = _Settling(estimate, offered).settled(choice.names)
    ablation = choice.ablation
    if settled != choice.names:
        # The evidence is that of the last term that was taken, at the lag that had most of it.
        chosen = next(row for row in ablation if row.is_selected)
        row = replace(_row(estimate, offered, settled), evidence=chosen.evidence)
        ablation = (*(replace(one, is_selected=False) for one in ablation), row)
    found = replace(estimate, ablation=ablation, candidates=candidates)
    return _refitted(found, settled) if settled else found


def candidates_of(prepared: Prepared, names: Sequence[str]) -> tuple[RegressorCandidate, ...]:
    """Return of the housekeeping columns ``names`` whether each may be a regressor."""
    samples, usable = prepared.referenced.samples, prepared.usable
    references = [prepared.observations.b_nt]
    for vectors in (samples.b_ref_gcrf_nt, samples.b_ref_base_nt):
        if vectors is not None and np.isfinite(vectors[usable]).all():
            references.append(vectors[usable])
    inertial_nt = inertial_field_nt(prepared.referenced, usable) if samples.b_ref_gcrf_nt is None else None
    if inertial_nt is not None and np.isfinite(inertial_nt).all():
        references.append(inertial_nt)
    beside = FieldBeside(prepared.observations.t_s, prepared.observations.h_nt, references)
    columns = {name: np.asarray(samples.housekeeping[name], np.float64)[usable] for name in names}
    return regressor_candidates(columns, beside)


def _named_candidates(prepared: Prepared) -> tuple[RegressorCandidate, ...]:
    keeping = prepared.referenced.samples.housekeeping
    named = [source for source in dict.fromkeys(map(source_of, prepared.names)) if source in keeping]
    return candidates_of(prepared, named) if named else ()


def _refitted(estimate: Estimate, names: tuple[str, ...]) -> Estimate:
    """Return the estimate with ``names`` among its terms: from the start, its clock looked for again beside them.

    What moves the bias may pass for an offset of the clock, or hide one.
    """
    again = started(estimate.prepared.with_names(names))
    if estimate.tried_clock is not None:
        again = with_clock(again)
    elif estimate.far_clock is not None:
        again = replace(again, coarse=estimate.coarse, far_clock=estimate.far_clock)
    return replace(again, ablation=estimate.ablation, candidates=estimate.candidates)


def _row(estimate: Estimate, offered: Observations, names: tuple[str, ...]) -> Ablation:
    columns = _columns(offered, names)
    return ablation_of(estimate.prepared.estimator, columns, estimate.settings, [names])[0]


def _columns(offered: Observations, names: Sequence[str]) -> Observations:
    """Return the observations with the terms ``names``, responses made of the reading."""
    made = {
        name: response_of(name, offered.h_nt, offered.t_s) if name in RESPONSES else offered.regressors[name]
        for name in names
    }
    return replace(offered, regressors=made)


@dataclass(frozen=True, slots=True, eq=False)
class _Settling:
    """What is made of chosen columns: whole triples, one lag of each, and responses of the sensor."""

    estimate: Estimate
    offered: Observations

    def settled(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the terms: conditions on lags, triples, responses and observability hold for each."""
        groups: list[tuple[tuple[str, ...], int]] = []
        plain = {lag_of(name)[0] for name in self.offered.regressors}
        three_of = {name: three for three in triples(sorted(plain)) for name in three}
        for name in names:
            source, lag = lag_of(name)
            sources: tuple[str, ...] = three_of.get(source) or (source,)
            if all(sources != known for known, _ in groups):
                groups.append((sources, lag))
        taken: tuple[str, ...] = ()
        for sources, lag in groups:
            more = self._best_lag(taken, sources, lag)
            if self._is_determined(taken, more):
                taken = (*taken, *more)
        return self._with_responses(taken)

    def _best_lag(self, taken: tuple[str, ...], sources: tuple[str, ...], lag: int) -> tuple[str, ...]:
        """Return the terms of one group at the lag that lowers the held-out residual by enough below lag 0."""
        none = tuple(lagged_name(one, 0) for one in sources)
        costs = {0: self._held_out((*taken, *none))}
        for other in dict.fromkeys((lag, *LAGS)):
            if other:
                costs[other] = self._held_out((*taken, *(lagged_name(one, other) for one in sources)))
        base = costs[0]
        if base is None:
            return none
        known = {k: cost for k, cost in costs.items() if cost is not None}
        best = min(known, key=lambda k: float(known[k].sum()))
        if best and _falls(base, known[best], LAG_GAIN):
            return tuple(lagged_name(one, best) for one in sources)
        return none

    def _with_responses(self, taken: tuple[str, ...]) -> tuple[str, ...]:
        if self.estimate.options.response != "auto":
            return taken
        for name in RESPONSES:
            before, after = self._held_out(taken), self._held_out((*taken, name))
            is_better = before is not None and after is not None and _falls(before, after, TERM_GAIN)
            if is_better and self._is_determined(taken, (name,)):
                taken = (*taken, name)
        return taken

    def _fit(self, names: Sequence[str]) -> Fit | None:
        try:
            return self.estimate.estimator.fit(_columns(self.offered, names), self.estimate.settings)
        except EstimationError:
            return None

    def _held_out(self, names: Sequence[str]) -> Floats | None:
        """Return the sum of squares of each block under the fit to the others, shape (m,); None where there is none."""
        fit, columns = self._fit(names), _columns(self.offered, names)
        if fit is None:
            return None
        unseen = held_out_residuals_nt(self.estimate.estimator, columns, self.estimate.settings, fit)
        if unseen is None:
            return None
        used = fit.weights > 0
        return np.array([np.sum(unseen[fold][used[fold]] ** 2) for fold in folds_of(columns.t_s)])

    def _is_determined(self, taken: Sequence[str], more: Sequence[str]) -> bool:
        """Return whether the sensor stays determined once the terms ``more`` are projected out."""
        fit = self._fit((*taken, *more))
        if fit is None:
            return False
        columns = _columns(self.offered, (*taken, *more))
        before, after = (index_beside(columns, fit, names) for names in (tuple(taken), (*taken, *more)))
        # A response is half a change of scale, a temperature half a wave of the orbit: what either leaves may be far
        # less than what there was, and be good by itself. The evidence is what keeps other columns out.
        is_kept = after >= min(INDEX_KEPT * before, WEAK_BELOW)
        return after >= LEAST_INDEX and is_kept


def index_beside(observations: Observations, fit: Fit, names: Sequence[str]) -> float:
    """Return the observability index with the terms ``names`` projected out of what determines the sensor.

    Notes
    -----
    Smallest singular value per root n of [u_i u_j |x|/B, u_i], u the direction of the corrected reading x, over
    sigma / B: as `observability.index`, after what the terms' own coefficients explain of it has been taken away.
    A column counts from its mean: where its zero is, in kelvin or in degrees Celsius, changes nothing of the field that
    a calibration corrects.
    """
    few = slice(None, None, max(1, len(observations) // _MOST))
    some, at = observations.take(few), fit.parameters
    x_nt = corrected_nt(some.with_regressors(tuple(at.regressors)), at)
    size = np.linalg.norm(x_nt, axis=1)
    field_nt, u = float(np.mean(size)), x_nt / size[:, None]
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    squares = [u[:, i] * u[:, j] * size / field_nt * (1.0 if i == j else np.sqrt(2.0)) for i, j in pairs]
    design, root = np.column_stack([*squares, u]), np.sqrt(fit.weights[few] > 0)[:, None]
    lower = at.correction_matrix
    terms = [(u @ lower) * _from_mean(some.regressors[name]).reshape(len(some), -1) for name in names]
    design = root * design
    if terms:
        basis = np.linalg.qr(root * np.column_stack([one / np.abs(one).max() for one in terms]))[0]
        design -= basis @ (basis.T @ design)
    noise = max(scale_of(fit.residuals_nt) / field_nt, SIGMA_FLOOR)
    return float(np.linalg.svd(design, compute_uv=False)[-1] / np.sqrt(max(float(root.sum()), 1.0)) / noise)


def _from_mean(column: Floats) -> Floats:
    """Return a column of one value a sample less its mean; a response, one a component, keeps its own zero."""
    return column - column.mean() if column.ndim == 1 else column


def _falls(before: Floats, after: Floats, gain: float) -> bool:
    """Return whether the held-out residual falls by a share ``gain``, and in most of the blocks."""
    return bool(
        after.sum() < (1.0 - gain) ** 2 * before.sum()
        and 2 * np.count_nonzero(after < before) > np.count_nonzero(before)
    )
