"""The Lagrange paper's vector calibration: least squares in the field, its four candidates, and what they are worth.

Notes
-----
The paper minimises the sum of [S (h - b) - B]^2 and finds four candidates for (a1, b3) by cross-multiplication
[LAGRANGE]_. In (p, q, a, s) its three rows are linear regressions with one stationary point each: the second root of
each quadratic is that point, the first is an artefact at which the paper's own equations contradict each other
(`docs/calibration.md`). The estimate is computed by centred QR, the candidates by the printed formulas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.closed_form_paper import Root, axis_1, axis_2_roots, axis_3_roots, sums_of
from magcal_core.calibration.estimators.closed_form_rows import InverseRows, fit_inverse_rows, reweighted_inverse
from magcal_core.calibration.estimators.contract import Candidate, Fit, FitSettings, FitStatus
from magcal_core.calibration.estimators.vector_rows import fit_rows, full_rows
from magcal_core.calibration.observability.excitation import axis_warnings, require_excitation, require_response
from magcal_core.numerics.blocks import BlockScores, block_moments, block_starts
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.model import parameters_of_matrix
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows, rows_jacobian
from magcal_core.sensor.parameters import Parameters

DISAGREEMENT: Final = 1e-8
"""Relative difference between the selected candidate and the QR estimate above which raw sums are not trusted."""
STATIONARY: Final = 1e-8
_NONE: Final = Standardised((), np.zeros((0, 0)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True)
class ClosedFormFit:
    """Least squares of T^-1 (h - b) - B with the paper's four candidates beside the estimate."""

    name: str = "vector-closed-form"
    is_vector: bool = True
    takes_regressors: bool = False
    has_moments: bool = False

    def fit(self, observations: Observations, settings: FitSettings) -> Fit:
        """Return the estimate and the candidates.

        Raises
        ------
        TelemetryValueError
            Attitude is unknown.
        TooFewSamplesError, NoExcitationError, CoplanarFieldError, DeadAxisError
            The samples do not determine every axis.
        """
        b_nt = observations.require_vector()
        require_excitation(b_nt, observations.weights)
        none = Standardised((), np.zeros((len(observations), 0)), np.zeros(0), np.zeros(0))
        begin = None if settings.begin is None else settings.begin.weights * observations.weights
        first = observations.weights if begin is None else begin
        forward = fit_rows(observations.h_nt, b_nt, none.columns, first)
        full = full_rows(forward, observations, none)
        for axis in range(3 if settings.is_gated else 0):
            responses = forward.significance(axis), forward.own_significance(axis)
            require_response(axis, forward.matrix[axis], *responses, full)
        rows = reweighted_inverse(observations.h_nt, b_nt, observations.weights, settings.robust, near=begin)
        if settings.robust != "none":
            # Whether the reference is turned is asked of the samples that the loss believes.
            full = full_rows(fit_rows(observations.h_nt, b_nt, none.columns, rows.weights), observations, none)
        noise = np.full(3, -1.0)
        if settings.noise_model == "white":
            noise = forward.sigma_nt if settings.noise_nt is None else np.full(3, settings.noise_nt)
            rows = fit_inverse_rows(observations.h_nt, b_nt, rows.weights, noise)
        parameters = parameters_from_rows(rows.matrix, rows.bias_nt, np.zeros((0, 3)), _NONE)
        own, covariance, blocks = _equations(rows)
        candidates, notes = _candidates(rows, settings.noise_model == "none")
        return Fit(
            method=self.name,
            parameters=parameters,
            covariance=own @ covariance @ own.T,
            residuals_nt=residuals_nt(observations, parameters, is_vector=True),
            weights=rows.weights,
            sigma_nt=float(np.sqrt(np.mean(rows.sigma_nt**2))),
            cost=float(np.sum(rows.weights[:, None] * rows.residuals_nt**2)),
            status=FitStatus.CONVERGED if rows.is_converged else FitStatus.MAX_EVALUATIONS,
            evaluations=rows.rounds,
            blocks=blocks,
            robust=settings.robust,
            noise_nt=float(np.sqrt(np.mean(noise**2))) if noise[0] >= 0 else -1.0,
            candidates=candidates,
            warnings=(*axis_warnings(parameters.scale, parameters.nonorthogonality_deg), *full.warnings, *notes),
            full_matrix=full,
        )

    def refit(self, observations: Observations, settings: FitSettings, near: Fit) -> Parameters:
        """Return the estimate from a part of the data, without candidates.

        Raises
        ------
        TooFewSamplesError, NoExcitationError, CoplanarFieldError
            The part does not determine every axis.
        """
        b_nt = observations.require_vector()
        require_excitation(b_nt, observations.weights)
        rows = reweighted_inverse(
            observations.h_nt, b_nt, observations.weights, near.robust, near=_same_rows(near, observations)
        )
        if settings.noise_model == "white":
            rows = fit_inverse_rows(observations.h_nt, b_nt, rows.weights, np.full(3, near.noise_nt))
        return parameters_from_rows(rows.matrix, rows.bias_nt, np.zeros((0, 3)), _NONE)


def _same_rows(near: Fit, observations: Observations) -> Floats | None:
    """Return the weights that ``near`` gave the rows of ``observations`` that are still there.

    None where nothing was rejected, or where the rows are others.
    """
    if len(near.weights) != len(observations) or near.weights.all():
        return None
    return np.where(observations.weights > 0, near.weights, 0.0)


def _equations(rows: InverseRows) -> tuple[Floats, Floats, BlockScores]:
    """Return the derivative of the parameters by the regressions' unknowns, their covariance, and both in blocks."""
    starts = block_starts(len(rows.weights))
    scores, normals = np.zeros((len(starts), 9)), np.zeros((len(starts), 9, 9))
    design = np.column_stack([-rows.b_nt[:, :2], rows.h_nt, np.ones(len(rows.h_nt))])
    weighted = design * rows.weights[:, None]
    moments = block_moments(weighted, design, starts)
    errors = block_moments(weighted, rows.residuals_nt, starts)
    for axis in range(3):
        take, at = np.array([*range(axis), 2 + axis, 5]), np.array(_positions(axis))
        share = 1.0 / rows.sigma_nt[axis] ** 2
        normals[:, at[:, None], at] += moments[:, take[:, None], take] * share
        scores[:, at] += errors[:, take, axis] * share
    own = rows_jacobian(rows.matrix, _NONE) @ rows.jacobian()
    return own, scaled_inverse(normals.sum(axis=0)) * rows.softening, BlockScores(scores, normals, starts, own)


def _positions(axis: int) -> list[int]:
    """Return where (coefficients of B_<i, p_i, q_i) of one row stand among (a21, p1.. | see `InverseRows.jacobian`)."""
    first = (0, 2, 5)[axis]
    return list(range(first, first + axis + 2))


def _candidates(rows: InverseRows, is_plain: bool) -> tuple[tuple[Candidate, ...], tuple[str, ...]]:
    """Return the four candidates of the printed formulas, and a warning where the selected one is not the estimate."""
    sums = sums_of(rows.h_nt, rows.b_nt, rows.weights)
    first = axis_1(sums)
    pairs = [(i, j) for i in (1, 2) for j in (1, 2)]
    seconds, thirds = axis_2_roots(sums), axis_3_roots(sums)
    drafts = [_draft(rows, (i, j), first, seconds[i - 1], thirds[j - 1]) for i, j in pairs]
    costs = [np.inf if draft.cost is None else draft.cost for draft in drafts]
    best = int(np.argmin(costs))
    selected = tuple(
        Candidate(
            draft.roots, draft.parameters, draft.cost, draft.stationarity, draft.is_stationary,
            bool(k == best and np.isfinite(costs[k])), draft.undefined, draft.spread,
        )
        for k, draft in enumerate(drafts)
    )  # fmt: skip
    if not is_plain:
        return selected, ()
    return selected, _disagreement(selected[best].parameters, rows)


def _disagreement(selected: Parameters | None, rows: InverseRows) -> tuple[str, ...]:
    if selected is None:
        return ("closed_form_undefined: no candidate of the printed formulas is defined; the estimate is by QR",)
    scale, angles_rad = parameters_of_matrix(rows.matrix)
    mine = np.concatenate([rows.bias_nt / np.maximum(np.abs(rows.bias_nt).max(), 1.0), scale, angles_rad])
    theirs = np.concatenate(
        [
            selected.bias_nt / np.maximum(np.abs(rows.bias_nt).max(), 1.0),
            selected.scale,
            np.deg2rad(selected.nonorthogonality_deg),
        ]
    )
    worst = float(np.max(np.abs(mine - theirs) / np.maximum(1.0, np.abs(mine))))
    if worst <= DISAGREEMENT:
        return ()
    return (f"closed_form_inaccurate: the selected candidate differs from the QR estimate by {worst:.1e} (raw sums)",)


def _draft(
    rows: InverseRows, roots: tuple[int, int], first: tuple[float, float], second: Root, third: Root
) -> Candidate:
    """Return one candidate with its cost and stationarity, or the reason why it is not defined."""
    h_nt, b_nt = rows.h_nt, rows.b_nt
    reason = second.undefined or third.undefined
    spread = _spread(second.formulas) | _spread(third.formulas)
    values = (*first, *second.values, *third.values)
    if reason is not None or not np.isfinite(values).all():
        return Candidate(roots, None, None, None, False, False, reason or "a formula divides by zero", spread)
    p1, b1, alpha1, p2, b2, s, alpha3, p3, b3 = values
    if min(abs(p1), abs(p2), abs(p3)) == 0.0:
        return Candidate(roots, None, None, None, False, False, "a gain is infinite: p = 0", spread)
    matrix = np.array([[1 / p1, 0, 0], [alpha1 / p2, 1 / p2, 0], [s / p3, alpha3 / p3, 1 / p3]])
    scale, angles_rad = parameters_of_matrix(matrix)
    parameters = Parameters(np.array([b1, b2, b3]), scale, np.rad2deg(angles_rad))
    trial = np.array([p1, p2, p3]) * (h_nt - parameters.bias_nt)
    errors = trial - b_nt
    errors[:, 1] -= alpha1 * b_nt[:, 0]
    errors[:, 2] -= s * b_nt[:, 0] + alpha3 * b_nt[:, 1]
    cost = float(np.sum(rows.weights[:, None] * errors**2))
    stationarity = max(rows.stationarity(axis, errors[:, axis]) for axis in range(3))
    return Candidate(roots, parameters, cost, stationarity, stationarity < STATIONARY, False, None, spread)


def _spread(formulas: Mapping[str, tuple[float, ...]]) -> dict[str, float]:
    """Return by how much the formulas that the paper calls equivalent differ, relative; NaN-free."""
    spread = {}
    for name, values in formulas.items():
        finite = [value for value in values if np.isfinite(value)]
        if len(finite) > 1:
            size = max(abs(value) for value in finite)
            spread[name] = float((max(finite) - min(finite)) / size) if size else 0.0
    return spread
