"""All nine elements of T from components, where the data give up the lower-triangular hypothesis.

Notes
-----
Twelve parameters, row by row: each h_i on B1, B2, B3 and 1, beside the terms of `locked` row by row. T12 = T13 = T23 =
0 is tested by Wald's statistic with *that* covariance, errors of the reference in it: three degrees of freedom. Soft
iron and a mounting that is not what the attitude says give it up; then the twelve are the result.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.parts import MISALIGNED_P
from magcal_core.calibration.terms.locked import LockedTerms, locked_terms
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.numerics.linear_algebra import scaled_condition, scaled_inverse
from magcal_core.numerics.tails import chi_square_of_three
from magcal_core.observations import Observations, corrected_nt
from magcal_core.sensor.correction import readings_without
from magcal_core.sensor.model import lower_triangular_gauge
from magcal_core.sensor.parameters import Parameters

_UPPER: Final = np.array([1, 2, 5])
"""Where T12, T13 and T23 stand among the elements of T, row by row."""
_BY_ROW: Final = np.array([0, 1, 2, 9, 3, 4, 5, 10, 6, 7, 8, 11])
"""Elements of T row by row and the bias -> T11 T12 T13 b1 T21 .."""
_STEP: Final = 1e-5
_SINGULAR: Final = 1e12
_WORTH_A_TEST: Final = 0.01
"""Probability, under white noise, above which no honest test gives the hypothesis up."""


@dataclass(frozen=True, slots=True, eq=False)
class FullMatrix:
    """The twelve parameters.

    Attributes
    ----------
    terms : LockedTerms
        With their covariance beside locked errors.
    covariance : shape (12, 12)
        Of T, row by row, and the bias; errors of the reference in it.
    parameter_covariance : shape (p, p)
        Of bias, scale and angles of T_low, and the rest, errors of the reference in it.
    p_value : float
        Of Wald's test that the three elements above the diagonal are zero.
    lower_residuals_nt : shape (n, 3)
        Residuals of the fit with a lower triangular T, base frame, nT.
    lower_parameters : Parameters
        The parameters of that fit.
    """

    terms: LockedTerms
    covariance: Floats
    parameter_covariance: Floats
    p_value: float
    lower_residuals_nt: Floats
    lower_parameters: Parameters

    @property
    def is_taken(self) -> bool:
        """Whether the data give the lower-triangular matrix up."""
        return self.p_value < MISALIGNED_P

    @property
    def matrix(self) -> Floats:
        """T, shape (3, 3)."""
        return self.terms.matrix

    @property
    def standard_errors(self) -> Floats:
        """Standard errors of the elements of T, shape (3, 3)."""
        found = np.zeros((3, 3))
        for row in range(3):
            found[row] = np.sqrt(np.diag(self.covariance[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]))
        return found

    @property
    def covariance_by_row(self) -> Floats:
        """The covariance in the order T11 T12 T13 b1 T21 .. b3, shape (12, 12)."""
        return np.asarray(self.covariance[_BY_ROW][:, _BY_ROW], np.float64)

    @property
    def rotation_deg(self) -> float:
        """Angle of the rotation R of T = T_low R, deg."""
        return _turn(self.matrix)

    @property
    def warning(self) -> str:
        """Say that the lower-triangular matrix was given up."""
        return (
            f"misaligned: soft iron or a mounting that turns the sensor by {self.rotation_deg:.2f} deg from its base "
            f"frame (p = {self.p_value:.1g}): all nine elements of the matrix are the result"
        )

    @property
    def rotation_error_deg(self) -> float:
        """Standard error of that angle, deg: by differences of the elements of T."""
        slopes = np.zeros(9)
        for at in range(9):
            ends = []
            for sign in (1.0, -1.0):
                moved = self.matrix.ravel().copy()
                moved[at] += sign * _STEP
                ends.append(_turn(moved.reshape(3, 3)))
            slopes[at] = (ends[0] - ends[1]) / (2.0 * _STEP)
        return float(np.sqrt(slopes @ self.covariance[:9, :9] @ slopes))

    def field_nt(self, observations: Observations) -> Floats:
        """Return the field in the base frame that the fit was made to, shape (n, 3), nT, at its clock."""
        return corrected_nt(observations, self.lower_parameters) - self.lower_residuals_nt

    def fit(self, observations: Observations, fit: Fit) -> Fit:
        """Return ``fit`` with the parameters of T_low and the residuals that the full matrix leaves."""
        parameters = self.terms.parameters
        reading = readings_without(observations.regressors, observations.h_nt, parameters) - parameters.bias_nt
        left = reading @ np.linalg.inv(self.matrix).T - self.field_nt(observations)
        return replace(fit, parameters=parameters, residuals_nt=left)


def _turn(matrix: Floats) -> float:
    """Return the angle, deg, of R in T = T_low R."""
    rotation = lower_triangular_gauge(matrix)[1]
    proper = rotation * np.sign(np.linalg.det(rotation))
    return float(np.rad2deg(np.arccos(np.clip((np.trace(proper) - 1.0) / 2.0, -1.0, 1.0))))


def p_of_lower(fit: Fit) -> float:
    """Return the probability of T12 = T13 = T23 = 0 that the method's own test gives; 1 where it makes none."""
    return 1.0 if fit.full_matrix is None else fit.full_matrix.p_value


def is_worth_a_test(p_value: float) -> bool:
    """Return whether an F-test under white noise leaves any doubt of the lower-triangular matrix."""
    return p_value < _WORTH_A_TEST


def full_matrix(
    observations: Observations,
    fit: Fit,
    columns: LockedColumns,
    errors: ReferenceErrors | None,
    duration_s: float,
) -> FullMatrix:
    """Return the twelve parameters from the weights of a vector ``fit``, and the test whether they are needed."""
    terms = locked_terms(observations, fit, columns, duration_s, "full")
    covariance = terms.unknown_covariance[:12, :12].copy()
    of_parameters = terms.covariance.copy()
    if errors is not None:
        linear, moves = errors.moves(observations, fit, is_full=True)
        covariance += moves[:, :12].T @ moves[:, :12]
        shifts = moves @ linear.unknowns.to_parameters(terms.matrix).T
        of_parameters += shifts.T @ shifts
    upper = terms.matrix.ravel()[_UPPER]
    wald = float(upper @ scaled_inverse(covariance[np.ix_(_UPPER, _UPPER)]) @ upper)
    p_value = chi_square_of_three(wald)
    return FullMatrix(terms, covariance, of_parameters, p_value, fit.residuals_nt, fit.parameters)


def unseen_rms_nt(observations: Observations, fit: Fit, full: FullMatrix) -> float | None:
    """Return the root mean square residual of a component, nT, of blocks that twelve parameters have not seen.

    The regressors' slopes stay those of all data. None where the rest does not determine the parameters.
    """
    field_nt = full.field_nt(observations)
    reading = readings_without(observations.regressors, observations.h_nt, full.terms.parameters)
    design = np.column_stack([field_nt, np.ones(len(field_nt))])
    back, squares, count = np.linalg.inv(full.matrix).T, 0.0, 0
    for fold in folds_of(observations.t_s):
        weights = fit.weights.copy()
        weights[fold] = 0.0
        normal = design.T @ (weights[:, None] * design)
        if scaled_condition(normal) > _SINGULAR:
            return None
        found = scaled_inverse(normal) @ design.T @ (weights[:, None] * reading)
        left = (reading[fold] - design[fold] @ found)[fit.weights[fold] > 0] @ back
        squares, count = squares + float(np.sum(left**2)), count + left.size
    return float(np.sqrt(squares / max(count, 1)))
