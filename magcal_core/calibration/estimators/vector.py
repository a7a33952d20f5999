"""Vector calibration where attitude is known: forward maximum likelihood, row by row of h = T B + b."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit, FitSettings, FitStatus
from magcal_core.calibration.estimators.vector_rows import Rows, full_rows, refitted, reweighted
from magcal_core.calibration.observability.excitation import axis_warnings, require_excitation, require_response
from magcal_core.numerics.blocks import BlockScores, block_starts
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.numerics.regression import block_sums
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows, rows_jacobian
from magcal_core.sensor.parameters import Parameters

_CLOCK_ROUNDS: Final = 20


@dataclass(frozen=True, slots=True)
class VectorFit:
    """Forward maximum likelihood: h_i on (B_1..B_i, 1) for each axis, noise in the reading, any sigma per axis."""

    name: str = "vector"
    is_vector: bool = True
    takes_regressors: bool = True
    has_moments: bool = True

    def fit(self, observations: Observations, settings: FitSettings) -> Fit:
        """Return the estimate.

        Raises
        ------
        TelemetryValueError
            Attitude is unknown.
        TooFewSamplesError, NoExcitationError, CoplanarFieldError, DeadAxisError
            The samples do not determine every axis.
        """
        b_nt = observations.require_vector()
        require_excitation(b_nt, observations.weights)
        names = tuple(observations.regressors)
        z = Standardised.of(names, [observations.regressors[name] for name in names], len(observations))
        rows, clock = _with_clock(observations, z, settings)
        full = full_rows(rows, observations, z)
        for axis in range(3 if settings.is_gated else 0):
            require_response(axis, rows.matrix[axis], rows.significance(axis), rows.own_significance(axis), full)
        parameters = parameters_from_rows(rows.matrix, rows.bias_nt, rows.slopes_nt, z)
        if clock.size:
            parameters = replace(parameters, time_offset_s=float(clock[0]))
        own, normal, blocks = _equations(observations, rows, z, clock)
        covariance = own @ scaled_inverse(normal) @ own.T * rows.softening
        return Fit(
            method=self.name,
            parameters=parameters,
            covariance=covariance,
            residuals_nt=residuals_nt(observations, parameters, is_vector=True),
            weights=rows.weights,
            sigma_nt=float(np.sqrt(np.mean(rows.sigma_nt**2))),
            cost=float(np.sum(rows.weights[:, None] * rows.residuals_nt**2)),
            status=FitStatus.CONVERGED if rows.is_converged else FitStatus.MAX_EVALUATIONS,
            evaluations=rows.rounds,
            blocks=blocks,
            clock=clock,
            robust=settings.robust,
            warnings=(*axis_warnings(parameters.scale, parameters.nonorthogonality_deg), *full.warnings),
            full_matrix=full,
        )

    def refit(self, observations: Observations, settings: FitSettings, near: Fit) -> Parameters:
        """Return the estimate from a part of the data; nothing but the rows is computed.

        Raises
        ------
        TooFewSamplesError, NoExcitationError, CoplanarFieldError
            The part does not determine every axis.
        """
        b_nt = observations.require_vector()
        require_excitation(b_nt, observations.weights)
        z = Standardised.of_weighed(observations.regressors, observations.weights)
        return refitted(observations.h_nt, b_nt, z, observations.weights, near.robust, near.parameters)


def _with_clock(observations: Observations, z: Standardised, settings: FitSettings) -> tuple[Rows, Floats]:
    """Return the rows, and the clock's unknowns that make them fit best (none where no rates are given)."""
    b_nt, rates = observations.require_vector(), observations.rate_base_nt_s
    weights, robust, near = observations.weights, settings.robust, settings.near
    begin = settings.begin.weights * weights if settings.begin is not None else None
    first = near.weights if near is not None else begin
    if first is not None and len(first) != len(weights):
        first = None
    if rates is None or rates.shape[1] == 0:
        return reweighted(observations.h_nt, b_nt, z.columns, weights, robust, near=first), np.zeros(0)
    clock = np.zeros(rates.shape[1])
    rows = reweighted(observations.h_nt, b_nt, z.columns, weights, robust, near=first)
    for _ in range(_CLOCK_ROUNDS):
        step = np.linalg.solve(*_clock_equations(rows, rates))
        clock = clock + step
        moved_nt = b_nt - np.einsum("nmi,m->ni", rates, clock)
        rows = reweighted(observations.h_nt, moved_nt, z.columns, weights, robust, near=rows.weights)
        if np.all(np.abs(step) < 1e-9 * np.maximum(1.0, np.abs(clock))):
            break
    return rows, clock


def _clock_equations(rows: Rows, rates: Floats) -> tuple[Floats, Floats]:
    """Return the normal matrix and right side of the clock with the rows' own unknowns eliminated.

    Notes
    -----
    From the moments of (B, z, rates, 1, residuals): a rate moves row i by -rate.T_i, a combination of its columns.
    """
    m, k = rates.shape[1], rows.z.shape[1]
    columns = np.concatenate([rows.b_nt.T, rows.z.T, rates.reshape(len(rates), 3 * m).T])
    columns -= (columns @ rows.weights / rows.weights.sum())[:, None]
    every = np.zeros(1, dtype=np.intp)
    moments = block_sums(columns, np.ascontiguousarray(rows.residuals_nt.T), rows.weights, every)[0]
    normal, right = np.zeros((m, m)), np.zeros(m)
    for axis in range(3):
        own = [*range(axis + 1), *range(3, 3 + k), 3 + k + 3 * m]
        carry = np.zeros((len(moments), m))
        for j in range(m):
            carry[3 + k + 3 * j : 6 + k + 3 * j, j] = -rows.matrix[axis]
        error = 4 + k + 3 * m + axis
        across = moments[own] @ carry
        explained = np.linalg.solve(moments[np.ix_(own, own)], np.column_stack([across, moments[own, error]]))
        share = 1.0 / rows.sigma_nt[axis] ** 2
        normal += share * (carry.T @ moments @ carry - across.T @ explained[:, :m])
        right += share * (carry.T @ moments[:, error] - across.T @ explained[:, m])
    return normal, right


def _equations(
    observations: Observations, rows: Rows, z: Standardised, clock: Floats
) -> tuple[Floats, Floats, BlockScores]:
    """Return the derivative of the reported parameters by the rows' unknowns, the normal matrix, and both in blocks."""
    k, m = len(z.names), clock.size
    q = 9 + 3 * k + m
    own = np.zeros((q, q))
    own[: q - m, : q - m] = rows_jacobian(rows.matrix, z)
    own[q - m :, q - m :] = np.eye(m)
    starts = block_starts(len(observations))
    rates = observations.rate_base_nt_s if m else None
    rate_columns = np.zeros((0, len(observations))) if rates is None else rates.reshape(len(rates), 3 * m).T
    columns = np.concatenate([rows.b_nt.T, rows.z.T, rate_columns])
    moments = block_sums(columns, np.ascontiguousarray(rows.residuals_nt.T), rows.weights, starts)
    scores, normals = axis_sums(moments, rows.matrix, 1.0 / rows.sigma_nt**2, k, m)
    return own, normals.sum(axis=0), BlockScores(scores, normals / rows.softening_slope, starts, own)


def axis_sums(moments: Floats, matrix: Floats, shares: Floats, k: int, m: int) -> tuple[Floats, Floats]:
    """Return the scores, shape (blocks, q), and normal matrices, shape (blocks, q, q), of the three rows.

    ``moments``: of (B, k regressors, three columns for each of the m unknowns of the clock, 1, residuals) of each
    block; ``matrix``: T; ``shares``: weight of each row, shape (3,). The scores have the derivative of the model in
    them.
    """
    q, c = 9 + 3 * k + m, 3 + k + 3 * m
    scores, normals = np.zeros((len(moments), q)), np.zeros((len(moments), q, q))
    for axis in range(3):
        carry = np.zeros((c + 1, axis + 2 + k + m))
        places = [*range(axis + 1), c, *range(3, 3 + k)]
        carry[places, range(len(places))] = 1.0
        for j in range(m):
            carry[3 + k + 3 * j : 6 + k + 3 * j, len(places) + j] = -matrix[axis]
        at = np.array([*_positions(axis, k), *range(q - m, q)])
        normals[:, at[:, None], at] += shares[axis] * (carry.T @ moments[:, : c + 1, : c + 1] @ carry)
        scores[:, at] += shares[axis] * (moments[:, : c + 1, c + 1 + axis] @ carry)
    return scores, normals


def _positions(axis: int, k: int) -> Sequence[int]:
    """Return where the unknowns of one row (T_i1..T_ii, b_i, slopes) stand among all."""
    first = (0, 1, 3)[axis]
    return [*range(first, first + axis + 1), 6 + axis, *(9 + 3 * j + axis for j in range(k))]
