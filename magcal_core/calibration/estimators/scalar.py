"""Scalar calibration: attitude-free, from |B| only; Levenberg-Marquardt from a closed-form start [DEKART]_."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit, FitSettings, FitStatus
from magcal_core.calibration.estimators.robust_start import scale_of
from magcal_core.calibration.estimators.scalar_descent import descend
from magcal_core.calibration.estimators.scalar_gate import (
    require_ellipsoid,
    require_observable,
    require_observable_fit,
    require_samples,
)
from magcal_core.calibration.estimators.scalar_kernel import accumulate, accumulate_blocks, residuals
from magcal_core.calibration.estimators.scalar_start import closed_form_starts
from magcal_core.calibration.observability.information import ENOUGH, PARAMETER_NAMES
from magcal_core.errors import NotObservableError
from magcal_core.numerics.blocks import BlockScores, block_starts
from magcal_core.numerics.levenberg_marquardt import Minimum
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.numerics.medians import median_size
from magcal_core.numerics.robust import GAUSSIAN_MAD, LOSSES, TUNING, robust_sigma, weights_and_slopes
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameterisation import (
    Standardised,
    parameters_from_rows,
    rows_from_theta,
    rows_jacobian,
    theta_jacobian,
    theta_of_parameters,
)
from magcal_core.sensor.parameters import Parameters

_PLAIN: Final = -1.0
_REACH: Final = 0.02
"""How far from the scale before, relative to it, the next one is looked for first."""
_ROUNDS: Final = 30
_STILL: Final = 1e-7
_STILL_ON_ALL: Final = 1e-4
"""Relative change of the robust scale that ends the iteration; of many samples it is known to 1e-3 only."""


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """The arrays of one scalar fit, and the evaluations that were spent on it."""

    observations: Observations
    z: Standardised
    floor: float = field(init=False)
    """Length of the vector of observations, nT: what is below its rounding is taken for zero."""

    def __post_init__(self) -> None:
        b_nt = self.observations.b_nt
        object.__setattr__(self, "floor", float(np.sqrt(np.dot(self.observations.weights * b_nt, b_nt))))

    @classmethod
    def of(cls, observations: Observations) -> _Task:
        names = tuple(observations.regressors)
        columns = [observations.regressors[name] for name in names]
        return cls(observations, Standardised.of(names, columns, len(observations)))

    @classmethod
    def of_weighed(cls, observations: Observations) -> _Task:
        """Return the task with regressors standardised over the samples that have weight."""
        return cls(observations, Standardised.of_weighed(observations.regressors, observations.weights))

    def thinned(self) -> _Task:
        """Return the same task on at most `ENOUGH` samples, evenly spaced."""
        step = len(self.observations) // ENOUGH
        if step < 2:
            return self
        z = replace(self.z, columns=np.ascontiguousarray(self.z.columns[::step]))
        return _Task(self.observations.take(slice(None, None, step)), z)

    @property
    def size(self) -> int:
        return 9 + 3 * len(self.z.names) + int(self.observations.rate_nt_s.shape[1])

    def minimise(self, theta: Floats, loss: int = 0, bend: float = 1.0, sigma: float = _PLAIN) -> Minimum:
        o = self.observations
        return descend(o.h_nt, o.b_nt, o.weights, self.z.columns, o.rate_nt_s, theta, loss, bend, sigma, self.floor)

    def approach(self, theta: Floats, loss: int, bend: float, sigma: float) -> Minimum:
        """Return where two reweighted steps lead: they cannot overshoot, as Newton's do far from the minimum."""
        o = self.observations
        arrays = (o.h_nt, o.b_nt, o.weights, self.z.columns, o.rate_nt_s)
        return descend(*arrays, theta, loss, bend, sigma, self.floor, is_newton=False, limit=3)

    def residuals(self, theta: Floats, sigma: float = _PLAIN) -> Floats:
        o = self.observations
        out = np.empty(len(o))
        residuals(o.h_nt, o.b_nt, self.z.columns, o.rate_nt_s, theta, sigma, out)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Where the search ended, with the loss and the noise that it ended under."""

    minimum: Minimum
    evaluations: int
    loss: int
    bend: float
    sigma: float

    def after(self, minimum: Minimum, bend: float, sigma: float) -> _Solution:
        return _Solution(minimum, self.evaluations + minimum.evaluations, self.loss, bend, sigma)


@dataclass(frozen=True, slots=True)
class ScalarFit:
    """Least squares of |T^-1 (h - b)| - |B|, with robust losses, noise model, regressors and clock offset."""

    name: str = "scalar"
    is_vector: bool = False
    takes_regressors: bool = True
    has_moments: bool = True

    def fit(self, observations: Observations, settings: FitSettings) -> Fit:
        """Return the estimate.

        Raises
        ------
        NotObservableError
            The samples do not determine the parameters; the message names them and the condition number.
        """
        require_samples(observations)
        task = _Task.of(observations)
        if settings.near is not None:
            return _assemble(self.name, task, _on_all(task, _beside(task, settings.near), settings))
        few = task.thinned()
        still = _STILL if few is task else _STILL_ON_ALL
        begin = settings.begin if settings.robust != "none" else None
        if begin is not None and begin.parameters is not None:
            solution = _begun(few, begin.parameters, begin.scale_nt, settings, still)
        else:
            plain = _plain(few, settings)
            require_ellipsoid(plain.minimum.theta)
            if settings.is_gated:
                require_observable(few.observations, plain.minimum.theta, plain.minimum.normal)
            solution = _refined(few, plain, settings, still)
        if few is not task:
            solution = _on_all(task, solution, settings)
        fit = _assemble(self.name, task, solution)
        if begin is not None and settings.is_gated:
            require_observable_fit(observations, fit)
        return fit

    def refit(self, observations: Observations, settings: FitSettings, near: Fit) -> Parameters:
        """Return the estimate near a known one, under its loss and noise.

        Raises
        ------
        NotObservableError
            The search does not end at a minimum.
        """
        task = _Task.of_weighed(observations)
        theta = theta_of_parameters(near.parameters, task.z)
        theta = np.concatenate([theta, np.zeros(task.size - theta.size)])
        loss = LOSSES[near.robust]
        found = task.minimise(theta, loss, TUNING[loss] * near.robust_scale_nt, near.noise_nt)
        if not found.is_converged:
            raise NotObservableError("the data do not hold a minimum near that of all data", PARAMETER_NAMES)
        theta = _right_handed(task, found).theta
        matrix, bias_nt, slopes_nt = rows_from_theta(theta, len(task.z.names))
        return parameters_from_rows(matrix, bias_nt, slopes_nt, task.z)


def _begun(task: _Task, at: Parameters, scale_nt: float, settings: FitSettings, still: float) -> _Solution:
    """Return the minimum under the loss from a start that bad rows have no part in: two reweighted steps go first."""
    loss = LOSSES[settings.robust]
    bare = replace(at, regressors={name: np.zeros(3) for name in task.z.names}, time_offset_s=None)
    theta, none = theta_of_parameters(bare, task.z), np.zeros((0, 0))
    theta = np.concatenate([theta, np.zeros(task.size - theta.size)])
    minimum = Minimum(theta, np.inf, none, none, 0, False)
    solution = _Solution(minimum, 0, loss, TUNING[loss] * scale_nt, _PLAIN)
    solution = _iterated(task, _approached(task, solution, settings), settings, still)
    return replace(solution, minimum=_right_handed(task, solution.minimum))


def _plain(task: _Task, settings: FitSettings) -> _Solution:
    """Return the plain least-squares minimum: from the best closed form, and from a given start where there is one."""
    o = task.observations
    extra = np.zeros(task.size - 9)
    starts = [np.concatenate([start, extra]) for start in closed_form_starts(o.h_nt, o.b_nt, o.weights)]
    best = task.minimise(min(starts, key=lambda start: float(o.weights @ task.residuals(start) ** 2)))
    evaluations = best.evaluations
    if settings.start is not None:
        theta = theta_of_parameters(settings.start, task.z)
        given = task.minimise(np.concatenate([theta, np.zeros(task.size - theta.size)]))
        evaluations += given.evaluations
        if given.cost < best.cost:
            best = given
    return _Solution(_right_handed(task, best), evaluations, 0, 1.0, _PLAIN)


def _right_handed(task: _Task, minimum: Minimum) -> Minimum:
    """Return the same minimum with a positive diagonal of L: |x| does not see the sign of a row."""
    theta = minimum.theta
    signs = np.where(theta[[0, 2, 5]] < 0, -1.0, 1.0)
    if np.all(signs > 0):
        return minimum
    k = len(task.z.names)
    flip = np.concatenate([signs[[0, 1, 1, 2, 2, 2]], np.tile(signs, k + 1), np.ones(theta.size - 9 - 3 * k)])
    return replace(
        minimum, theta=theta * flip, normal=minimum.normal * np.outer(flip, flip), gradient=minimum.gradient * flip
    )


def _refined(task: _Task, plain: _Solution, settings: FitSettings, still: float) -> _Solution:
    """Return the minimum under the robust loss and the noise model asked for, with its scale known to ``still``."""
    is_white, is_robust = settings.noise_model == "white", settings.robust != "none"
    solution = plain
    if is_robust:
        # The convex loss first: from there the redescending ones cannot fall into a neighbour's minimum.
        solution = _approached(task, replace(plain, loss=LOSSES["soft_l1"]), settings)
        if settings.robust != "soft_l1":
            solution = _iterated(task, solution, settings, _STILL_ON_ALL)
            solution = replace(solution, loss=LOSSES[settings.robust])
        solution = _iterated(task, solution, settings, still)
    elif is_white:
        solution = _iterated(task, solution, settings, still)
    return replace(solution, minimum=_right_handed(task, solution.minimum))


def _beside(task: _Task, near: Fit) -> _Solution:
    """Return the solution that ``near`` is, as a start for nearly the same data; clocks begin where the data are."""
    loss, theta = LOSSES[near.robust], theta_of_parameters(near.parameters, task.z)
    theta, none = np.concatenate([theta, np.zeros(task.size - theta.size)]), np.zeros((0, 0))
    minimum = Minimum(theta, near.cost, none, none, 0, False)
    return _Solution(minimum, 0, loss, TUNING[loss] * near.robust_scale_nt, near.noise_nt)


def _on_all(task: _Task, near: _Solution, settings: FitSettings) -> _Solution:
    """Return the minimum over all samples, next to that over some of them or over nearly the same ones."""
    is_white, is_large = settings.noise_model == "white", len(task.observations) >= 2 * ENOUGH
    if near.loss or is_white:
        solution = _iterated(task, near, settings, _STILL_ON_ALL if is_large else _STILL)
    else:
        solution = near.after(task.minimise(near.minimum.theta), near.bend, near.sigma)
    return replace(solution, minimum=_right_handed(task, solution.minimum))


def _approached(task: _Task, solution: _Solution, settings: FitSettings) -> _Solution:
    """Return the solution some steps nearer to the minimum under its loss, from where Newton's steps lead on."""
    scale, sigma = _scale(task, solution, settings)
    bend = TUNING[solution.loss] * scale
    return solution.after(task.approach(solution.minimum.theta, solution.loss, bend, sigma), bend, sigma)


def _scale(task: _Task, solution: _Solution, settings: FitSettings) -> tuple[float, float]:
    """Return the robust scale of the residuals and the noise of a component, nT, that they show.

    Where a start was given because rows are bad, these have no part in the scale either.
    """
    is_white, noise_nt = settings.noise_model == "white", settings.noise_nt
    floor = 1e-9 * task.floor / np.sqrt(len(task.observations))
    theta, sigma = solution.minimum.theta, _PLAIN
    if is_white:
        sigma = noise_nt if noise_nt is not None else _noise(task, theta, solution, floor)
    if not solution.loss:
        return max(sigma, floor), sigma
    r = task.residuals(theta, sigma)
    if settings.begin is not None:
        return max(scale_of(r[task.observations.weights > 0]), floor), sigma
    before = solution.bend / (TUNING[solution.loss] * GAUSSIAN_MAD)
    median = median_size(r, task.observations.weights, before, _REACH, np.empty_like(r))
    return max(GAUSSIAN_MAD * float(median), floor), sigma


def _iterated(task: _Task, solution: _Solution, settings: FitSettings, still: float) -> _Solution:
    """Return the minimum under the solution's loss, with scale and noise re-estimated until they converge."""
    previous, is_white = np.inf, settings.noise_model == "white"
    for _ in range(_ROUNDS):
        scale, sigma = _scale(task, solution, settings)
        if abs(scale - previous) <= still * scale:
            break
        previous = scale
        bend = TUNING[solution.loss] * scale
        solution = solution.after(task.minimise(solution.minimum.theta, solution.loss, bend, sigma), bend, sigma)
        if not is_white and not solution.loss:
            break
    return solution


def _noise(task: _Task, theta: Floats, solution: _Solution, floor: float) -> float:
    """Return the noise of a component, nT, that the geometric residuals show."""
    weights = task.observations.weights
    r = task.residuals(theta, max(solution.sigma, 0.0))
    if solution.loss:
        return robust_sigma(r[weights > 0], floor)
    dof = int(np.count_nonzero(weights > 0)) - task.size
    return max(float(np.sqrt(np.sum(weights * r**2) / dof)), floor)


def fit_at(name: str, observations: Observations, theta: Floats, guide: Fit) -> Fit:
    """Return the fit, with its formal covariance, at unknowns that another search found under ``guide``'s weights."""
    task = _Task.of(observations)
    loss, sigma = LOSSES[guide.robust], guide.noise_nt
    bend, o, p = TUNING[loss] * guide.robust_scale_nt, observations, theta.size
    normal, gradient = np.empty((p, p)), np.empty(p)
    cost = accumulate(
        o.h_nt, o.b_nt, o.weights, task.z.columns, o.rate_nt_s, theta, loss, bend, sigma, False, normal, gradient
    )
    minimum = Minimum(theta, float(cost), normal, gradient, 1, True)
    return _assemble(name, task, _Solution(minimum, 1, loss, bend, sigma))


def _assemble(name: str, task: _Task, solution: _Solution) -> Fit:
    minimum, k, prior = solution.minimum, len(task.z.names), task.observations.weights
    robust = next(key for key, number in LOSSES.items() if number == solution.loss)
    r = task.residuals(minimum.theta, solution.sigma)
    dof = int(np.count_nonzero(prior > 0)) - task.size
    weight, slope = weights_and_slopes(r, robust, solution.bend / TUNING[solution.loss])
    # Variance of an M-estimate: mean psi^2 / (mean psi')^2 in place of the mean square.
    softening = float(prior @ weight) / max(float(prior @ slope), 0.05 * float(prior.sum()))
    r *= weight
    sigma = float(np.sqrt(np.einsum("i,i,i->", prior, r, r) / dof))
    own = _own_jacobian(task, minimum.theta)
    starts, scores, normals = _block_sums(task, solution)
    inverse = scaled_inverse(normals.sum(axis=0)) * softening
    covariance = own @ inverse @ own.T * sigma**2 * softening / (prior @ weight / prior.sum())
    matrix, bias_nt, slopes_nt = rows_from_theta(minimum.theta, k)
    parameters = parameters_from_rows(matrix, bias_nt, slopes_nt, task.z)
    clock = minimum.theta[9 + 3 * k :]
    if clock.size:
        parameters = replace(parameters, time_offset_s=float(clock[0]))
    return Fit(
        method=name,
        parameters=parameters,
        covariance=covariance,
        residuals_nt=residuals_nt(task.observations, parameters, is_vector=False),
        weights=prior * weight,
        sigma_nt=sigma,
        robust=robust,
        robust_scale_nt=solution.bend / TUNING[solution.loss],
        noise_nt=solution.sigma,
        cost=minimum.cost,
        status=FitStatus.CONVERGED if minimum.is_converged else FitStatus.MAX_EVALUATIONS,
        evaluations=solution.evaluations,
        clock=clock,
        blocks=BlockScores(scores, normals / softening, starts, own),
    )


def _own_jacobian(task: _Task, theta: Floats) -> Floats:
    """Return the derivative of the reported parameters by (L, c, d, clock)."""
    k, m = len(task.z.names), task.observations.rate_nt_s.shape[1]
    inner = 9 + 3 * k
    jacobian = np.zeros((inner + m, inner + m))
    matrix, _, _ = rows_from_theta(theta, k)
    jacobian[:inner, :inner] = rows_jacobian(matrix, task.z) @ theta_jacobian(theta, k)
    jacobian[inner:, inner:] = np.eye(m)
    return jacobian


def _block_sums(task: _Task, solution: _Solution) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Return the first samples of blocks, and the sums of J^T W r and of J^T W J over each."""
    o, p = task.observations, task.size
    starts = block_starts(len(o))
    scores, normals = np.empty((len(starts), p)), np.empty((len(starts), p, p))
    arrays = (o.h_nt, o.b_nt, o.weights, task.z.columns, o.rate_nt_s, solution.minimum.theta)
    accumulate_blocks(*arrays, solution.loss, solution.bend, solution.sigma, starts, normals, scores)
    return starts, scores, normals
