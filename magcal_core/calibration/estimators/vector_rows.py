"""Rows of h = T B + b by weighted linear least squares, with robust weights that all three axes share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.parts import FullMatrix
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.numerics.regression import Regression
from magcal_core.numerics.robust import robust_sigma, shared_weight_slope
from magcal_core.observations import Observations
from magcal_core.sensor.model import lower_triangular_gauge
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows, rows_from_theta, theta_of_parameters
from magcal_core.sensor.parameters import Parameters

_WIDE: Final = (1, 2, 3)
_NEXT_TO: Final = 1e-3
_ALMOST_STILL: Final = 1e-6
"""Movement of a residual, in units of the noise, at which a loss hands on to the next one, and a refit ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Three regressions and what was used to make them.

    Attributes
    ----------
    b_nt, z : shape (n, 3), (n, k)
        Field in the base frame, nT; standardised regressors.
    matrix, bias_nt, slopes_nt : shape (3, 3), (3,), (k, 3)
    residuals_nt : shape (n, 3)
        h - model, nT, along the sensor's axes.
    sigma_nt : shape (3,)
        Noise of each axis, nT: root of RSS / (n - unknowns of the row).
    weights : shape (n,)
    softening, softening_slope : float
        What a robust loss multiplies the formal covariance by, and divides the normal matrix by.
    """

    b_nt: Floats
    z: Floats
    matrix: Floats
    bias_nt: Floats
    slopes_nt: Floats
    residuals_nt: Floats
    sigma_nt: Floats
    weights: Floats
    covariances: tuple[Floats, Floats, Floats]
    softening: float = 1.0
    softening_slope: float = 1.0
    rounds: int = 1
    is_converged: bool = True

    def significance(self, axis: int) -> float:
        """Return by how many standard errors the row of T differs from zero."""
        gain = self.matrix[axis, : axis + 1]
        information = np.linalg.inv(self.covariances[axis][: axis + 1, : axis + 1])
        return float(np.sqrt(gain @ information @ gain))

    def own_significance(self, axis: int) -> float:
        """Return by how many standard errors the gain to the axis' own component differs from zero."""
        return float(abs(self.matrix[axis, axis]) / np.sqrt(self.covariances[axis][axis, axis]))


def _regression(h_nt: Floats, b_nt: Floats, z: Floats, weights: Floats, wide: tuple[int, int, int]) -> Regression:
    """Return the regression of row i on the first ``wide[i]`` components of the field, 1 and z."""
    takes = np.ones((3, 3 + z.shape[1]), dtype=bool)
    for axis in range(3):
        takes[axis, wide[axis] : 3] = False
    return Regression(np.concatenate([b_nt.T, z.T]), h_nt.T, takes, weights)


def _rows(regression: Regression, b_nt: Floats, z: Floats, weights: Floats, wide: tuple[int, int, int]) -> Rows:
    """Return the rows that the regression has found under ``weights``, with their errors."""
    k = z.shape[1]
    count = int(np.count_nonzero(weights > 0))
    matrix, bias, slopes = _found(regression, k, wide)
    sigma, covariances = np.zeros(3), []
    for axis, columns in enumerate(wide):
        noise = np.sqrt(regression.squares[axis] / max(count - columns - 1 - k, 1))
        sigma[axis] = max(noise, regression.smallest[axis])
        covariances.append(_covariance(regression, columns, k) * sigma[axis] ** 2)
    triple = (covariances[0], covariances[1], covariances[2])
    residuals = np.ascontiguousarray(regression.residuals.T)
    return Rows(b_nt, z, matrix, bias, slopes, residuals, sigma, weights, triple)


def _covariance(regression: Regression, wide: int, k: int) -> Floats:
    """Return the covariance of (gains, bias, slopes) for unit noise, from the moments about the centre."""
    at = np.array([*range(wide), 3 + k, *range(3, 3 + k)])
    upper = np.triu(regression.total)
    normal = (upper + np.triu(upper, 1).T)[np.ix_(at, at)]
    carry = np.eye(len(at))
    carry[wide, :wide], carry[wide, wide + 1 :] = -regression.centre[:wide], -regression.centre[3:]
    return np.asarray(carry @ scaled_inverse(normal) @ carry.T)


def fit_rows(h_nt: Floats, b_nt: Floats, z: Floats, weights: Floats, columns: tuple[int, int, int] = (1, 2, 3)) -> Rows:
    """Return the weighted least-squares rows: row i on the first ``columns[i]`` components of the field, 1 and z.

    Raises
    ------
    NotObservableError
        A regressor is a combination of others, of the field and of a constant.
    """
    regression = _regression(h_nt, b_nt, z, weights, columns)
    regression.solve(weights)
    return _rows(regression, b_nt, z, weights, columns)


def reweighted(  # noqa: PLR0917
    h_nt: Floats, b_nt: Floats, z: Floats, prior: Floats, robust: str, near: Floats | None = None
) -> Rows:
    """Return the rows under a robust loss: the worst of a sample's three residuals decides its weight.

    The convex soft-L1 loss goes first, so that a redescending loss starts next to the right minimum; not so where
    ``near`` is given, the weights, shape (n,), that the loss gave on nearly the same data.

    Raises
    ------
    NotObservableError
        A regressor is a combination of others, of the field and of a constant.
    """
    first = prior if near is None or robust == "none" else near
    regression = _regression(h_nt, b_nt, z, first, _WIDE)
    regression.solve(first)
    if robust == "none":
        return _rows(regression, b_nt, z, prior, _WIDE)
    if near is None and robust != "soft_l1":
        regression.reweigh(prior, "soft_l1", _NEXT_TO)
    weights, rounds, is_converged = regression.reweigh(prior, robust)
    rows = _rows(regression, b_nt, z, weights, _WIDE)
    softening, share = _softening(rows, prior, robust, 1e-12 * float(np.abs(h_nt).max()))
    return replace(rows, softening=softening, softening_slope=share, rounds=rounds, is_converged=is_converged)


def refitted(  # noqa: PLR0917
    h_nt: Floats, b_nt: Floats, z: Standardised, weights: Floats, robust: str, near: Parameters
) -> Parameters:
    """Return the parameters of the rows alone, from ``near`` on, to a millionth of the noise.

    Raises
    ------
    NotObservableError
        A regressor is a combination of others, of the field and of a constant.
    """
    regression = _regression(h_nt, b_nt, z.columns, weights, _WIDE)
    if robust == "none":
        regression.solve(weights)
    else:
        lower = theta_of_parameters(near, z)
        matrix, bias_nt, slopes_nt = rows_from_theta(lower, len(z.names))
        regression.begin(np.concatenate([matrix, slopes_nt.T], axis=1), bias_nt)
        regression.reweigh(weights, robust, _ALMOST_STILL)
    matrix, bias_nt, slopes_nt = _found(regression, len(z.names), _WIDE)
    return parameters_from_rows(matrix, bias_nt, slopes_nt, z)


def _found(regression: Regression, k: int, wide: tuple[int, int, int]) -> tuple[Floats, Floats, Floats]:
    """Return matrix, bias and slopes, shape (k, 3), that the regression has found."""
    found, matrix = regression.coefficients, np.zeros((3, 3))
    for axis, columns in enumerate(wide):
        matrix[axis, :columns] = found[axis, :columns]
    return matrix, found[:, -1] - found[:, :-1] @ regression.centre, np.ascontiguousarray(found[:, 3 : 3 + k].T)


def whole_residuals_nt(observations: Observations) -> Floats:
    """Return h less the plain fit of all nine elements of T, the bias and the regressors, shape (n, 3), nT."""
    names = tuple(observations.regressors)
    z = Standardised.of(names, [observations.regressors[name] for name in names], len(observations))
    b_nt = observations.require_vector()
    return fit_rows(observations.h_nt, b_nt, z.columns, observations.weights, (3, 3, 3)).residuals_nt


def _softening(rows: Rows, prior: Floats, robust: str, floor: float) -> tuple[float, float]:
    """Return what the loss multiplies the formal covariance by, and divides the normal matrix by."""
    used = prior > 0
    scales = [robust_sigma(rows.residuals_nt[used, axis], floor) for axis in range(3)]
    weight = np.divide(rows.weights, prior, out=np.zeros_like(prior), where=used)
    share = shared_weight_slope(rows.residuals_nt / scales, prior, weight, robust)
    squares = rows.residuals_nt**2
    psi, plain = (rows.weights * weight) @ squares, rows.weights @ squares
    mean_weight = float(rows.weights.sum() / prior.sum())
    return share**2 / mean_weight * float(np.max(psi / np.maximum(plain, 1e-300))), share


def full_rows(rows: Rows, observations: Observations, z: Standardised) -> FullMatrix:
    """Return the twelve-parameter fit with the weights of ``rows`` and the F-test of T12 = T13 = T23 = 0."""
    from scipy.special import fdtrc

    full = fit_rows(observations.h_nt, rows.b_nt, z.columns, rows.weights, (3, 3, 3))
    dof = int(np.count_nonzero(rows.weights > 0)) - 4 - len(z.names)
    gain = np.sum(rows.weights[:, None] * (rows.residuals_nt**2 - full.residuals_nt**2), axis=0)
    f_statistic = max(float(np.sum(gain / full.sigma_nt**2) / 3.0), 0.0)
    lower, rotation = lower_triangular_gauge(full.matrix)
    # Regular: the smallest gain in any direction is many times its error.
    error = max(float(np.sqrt(np.trace(full.covariances[axis][:3, :3]))) for axis in range(3))
    is_regular = bool(np.linalg.svd(full.matrix, compute_uv=False)[2] > 10.0 * error)
    p_value = float(fdtrc(3, 3 * max(dof, 1), f_statistic))
    return FullMatrix(full.matrix, f_statistic, p_value, lower, rotation, is_regular)
