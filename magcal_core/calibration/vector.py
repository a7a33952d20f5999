"""Vector calibration where attitude is known: forward maximum likelihood, row by row of h = T B + b."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.excitation import axis_warnings, require_excitation, require_response
from magcal_core.calibration.fit import (
    BlockScores,
    Fit,
    FitSettings,
    FitStatus,
    Observations,
    block_moments,
    block_starts,
    residuals_nt,
    scaled_inverse,
)
from magcal_core.calibration.jacobians import Standardised, parameters_from_rows, rows_jacobian
from magcal_core.calibration.result import Parameters
from magcal_core.calibration.rows import Rows, full_rows, reweighted

Floats = NDArray[np.float64]

_CLOCK_ROUNDS: Final = 20


@dataclass(frozen=True, slots=True)
class VectorFit:
    """Forward maximum likelihood: h_i on (B_1..B_i, 1) for each axis, noise in the reading, any sigma per axis."""

    name: str = "vector"
    is_vector: bool = True
    takes_regressors: bool = True

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
        rows, clock = _with_clock(observations, z, settings.robust)
        full = full_rows(rows, observations, z)
        for axis in range(3):
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
            extras={"full_matrix": full.to_dict()},
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
        names = tuple(observations.regressors)
        z = Standardised.of(names, [observations.regressors[name] for name in names], len(observations))
        rows = reweighted(observations.h_nt, b_nt, z.columns, observations.weights, near.robust)
        return parameters_from_rows(rows.matrix, rows.bias_nt, rows.slopes_nt, z)


def _with_clock(observations: Observations, z: Standardised, robust: str) -> tuple[Rows, Floats]:
    """Return the rows, and the clock's unknowns that make them fit best (none where no rates are given)."""
    b_nt, rates = observations.require_vector(), observations.rate_base_nt_s
    weights = observations.weights
    if rates is None or rates.shape[1] == 0:
        return reweighted(observations.h_nt, b_nt, z.columns, weights, robust), np.zeros(0)
    clock = np.zeros(rates.shape[1])
    rows = reweighted(observations.h_nt, b_nt, z.columns, weights, robust)
    for _ in range(_CLOCK_ROUNDS):
        step = np.linalg.solve(*_clock_equations(rows, rates))
        clock = clock + step
        moved_nt = b_nt - np.einsum("nmi,m->ni", rates, clock)
        rows = reweighted(observations.h_nt, moved_nt, z.columns, weights, robust, near=rows)
        if np.all(np.abs(step) < 1e-9 * np.maximum(1.0, np.abs(clock))):
            break
    return rows, clock


def _clock_equations(rows: Rows, rates: Floats) -> tuple[Floats, Floats]:
    """Return the normal matrix and right side of the clock with the rows' own unknowns eliminated."""
    m = rates.shape[1]
    normal, right = np.zeros((m, m)), np.zeros(m)
    for axis in range(3):
        columns = -np.einsum("nmi,i->nm", rates, rows.matrix[axis])
        rest = columns - rows.project(axis, columns)
        share = rows.weights / rows.sigma_nt[axis] ** 2
        normal += (rest * share[:, None]).T @ rest
        right += (rest * share[:, None]).T @ rows.residuals_nt[:, axis]
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
    scores, normals = np.zeros((len(starts), q)), np.zeros((len(starts), q, q))
    shared = [rows.b_nt, np.ones((len(rows.b_nt), 1)), rows.z]
    if observations.rate_base_nt_s is not None and m:
        shared += [-observations.rate_base_nt_s @ rows.matrix[axis] for axis in range(3)]
    design = np.column_stack(shared)
    weighted = design * rows.weights[:, None]
    moments = block_moments(weighted, design, starts)
    errors = block_moments(weighted, rows.residuals_nt, starts)
    for axis in range(3):
        clocks = list(range(4 + k + m * axis, 4 + k + m * (axis + 1)))
        take = [*range(axis + 1), 3, *range(4, 4 + k), *clocks]
        at = np.array([*_positions(axis, k), *range(q - m, q)])
        share = 1.0 / rows.sigma_nt[axis] ** 2
        normals[:, at[:, None], at] += moments[:, np.array(take)[:, None], take] * share
        scores[:, at] += errors[:, take, axis] * share
    return own, normals.sum(axis=0), BlockScores(scores, normals / rows.softening_slope, starts, own)


def _positions(axis: int, k: int) -> Sequence[int]:
    """Return where the unknowns of one row (T_i1..T_ii, b_i, slopes) stand among all."""
    first = (0, 1, 3)[axis]
    return [*range(first, first + axis + 1), 6 + axis, *(9 + 3 * j + axis for j in range(k))]
