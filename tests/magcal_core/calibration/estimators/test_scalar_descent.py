"""The compiled search against the same search in Python, and folds without weight against folds that are not there."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.estimators.scalar_descent import descend
from magcal_core.calibration.estimators.scalar_kernel import accumulate
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.numerics.levenberg_marquardt import Minimum, minimise
from magcal_core.numerics.robust import LOSSES, TUNING
from magcal_core.observations import Observations


def _observations(mission, regressors: bool) -> Observations:
    samples = mission(noise_nt=80.0, seed=5).samples
    random = np.random.default_rng(6)
    n = len(samples)
    samples = replace(samples, housekeeping={"temperature": 20.0 + 5.0 * np.sin(np.arange(n) / 90.0)})
    observations = Observations.of(samples, ("temperature",) if regressors else ())
    rate = random.normal(size=(n, 1)) * 17.0 if regressors else np.zeros((n, 0))
    return replace(observations, rate_nt_s=rate)


def _both(o: Observations, loss: str, sigma: float, is_newton: bool = True) -> tuple[Minimum, Minimum]:
    columns = [column - column.mean() for column in o.regressors.values()]
    z = np.ascontiguousarray(np.column_stack(columns)) if columns else np.zeros((len(o), 0))
    theta = np.concatenate([[1.0, 0.0, 1.0, 0.0, 0.0, 1.0], np.zeros(3 + 3 * len(columns) + o.rate_nt_s.shape[1])])
    bend, floor = TUNING[LOSSES[loss]] * 100.0, float(np.sqrt(np.sum(o.b_nt**2)))

    def evaluate(at, normal, gradient):
        arrays = (o.h_nt, o.b_nt, o.weights, z, o.rate_nt_s)
        return float(accumulate(*arrays, at, LOSSES[loss], bend, sigma, is_newton, normal, gradient))

    arrays = (o.h_nt, o.b_nt, o.weights, z, o.rate_nt_s)
    fast = descend(*arrays, theta, LOSSES[loss], bend, sigma, floor, is_newton=is_newton)
    return minimise(evaluate, theta, floor), fast


@pytest.mark.parametrize("loss", list(LOSSES))
@pytest.mark.parametrize("sigma", [-1.0, 80.0])
@pytest.mark.parametrize("regressors", [False, True])
@pytest.mark.parametrize("is_newton", [False, True])
def test_the_compiled_search_takes_the_same_way_as_the_one_in_python(mission, loss, sigma, regressors, is_newton):
    """Same steps from the same start: equal but for the order of a few sums, 1e-9 of the largest unknown."""
    slow, fast = _both(_observations(mission, regressors), loss, sigma, is_newton)
    assert (fast.evaluations, fast.is_converged) == (slow.evaluations, slow.is_converged)
    np.testing.assert_allclose(fast.theta, slow.theta, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(fast.cost, slow.cost, rtol=1e-11)
    np.testing.assert_allclose(fast.normal, slow.normal, rtol=1e-8, atol=1e-8 * np.abs(slow.normal).max())


@pytest.mark.parametrize("loss", list(LOSSES)[1:])
@pytest.mark.parametrize("sigma", [-1.0, 80.0])
def test_newtons_steps_end_where_reweighted_ones_do_in_fewer_passes(mission, loss, sigma):
    """From the plain minimum, with every tenth sample struck: one minimum, to 1e-7 of the largest of a kind, 0.1 us."""
    o, random = _observations(mission, True), np.random.default_rng(8)
    struck = np.where(np.arange(len(o)) % 10 == 3, random.uniform(2000.0, 20000.0, len(o)), 0.0)
    h_nt = o.h_nt + struck[:, None] * np.array([1.0, 0.0, 0.0])
    z = np.ascontiguousarray(np.column_stack(list(o.regressors.values()))) / 20.0
    arrays, floor = (h_nt, o.b_nt, o.weights, z, o.rate_nt_s), float(np.sqrt(np.sum(o.b_nt**2)))
    start = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0, *np.zeros(7)])
    plain = descend(*arrays, start, 0, 1.0, sigma, floor).theta
    soft = descend(*arrays, plain, LOSSES["soft_l1"], 110.0, sigma, floor, is_newton=False).theta
    how = (soft, LOSSES[loss], 80.0 * TUNING[LOSSES[loss]], sigma, floor)
    slow, fast = (descend(*arrays, *how, is_newton=is_newton) for is_newton in (False, True))
    assert slow.is_converged and fast.is_converged
    assert fast.evaluations < slow.evaluations
    np.testing.assert_allclose(fast.cost, slow.cost, rtol=1e-12)
    size = np.abs(slow.theta)
    scale = np.repeat([size[:6].max(), size[6:9].max(), size[9:12].max(), 1.0], [6, 3, 3, 1])
    np.testing.assert_allclose(fast.theta / scale, slow.theta / scale, atol=1e-7)


@pytest.mark.parametrize("count", [1, 7, 255, 256, 257, 700])
def test_chunks_of_any_length_add_up(mission, count):
    """One call over the samples against one call a sample: sums in another order, 1e-11."""
    o = _observations(mission, True).take(slice(0, count))
    z = np.ascontiguousarray(np.column_stack(list(o.regressors.values()))) / 20.0
    theta = np.array([0.98, 0.01, 1.02, -0.02, 0.03, 0.97, 2900.0, -1200.0, -1800.0, 30.0, -20.0, 10.0, 0.4])
    p = theta.size
    whole, gradient = np.empty((p, p)), np.empty(p)
    cost = accumulate(o.h_nt, o.b_nt, o.weights, z, o.rate_nt_s, theta, 2, 135.0, 60.0, False, whole, gradient)
    normals, gradients, costs = np.zeros((p, p)), np.zeros(p), 0.0
    for i in range(count):
        one, slope = np.empty((p, p)), np.empty(p)
        at = slice(i, i + 1)
        arrays = (o.h_nt[at], o.b_nt[at], o.weights[at], z[at], o.rate_nt_s[at])
        costs += accumulate(*arrays, theta, 2, 135.0, 60.0, False, one, slope)
        normals, gradients = normals + one, gradients + slope
    np.testing.assert_allclose(cost, costs, rtol=1e-11)
    np.testing.assert_allclose(whole, normals, rtol=1e-11, atol=1e-11 * np.abs(normals).max())
    np.testing.assert_allclose(gradient, gradients, rtol=1e-9, atol=1e-9 * np.abs(gradients).max())


@pytest.mark.parametrize("method", list(ESTIMATORS))
@pytest.mark.parametrize("robust", ["none", "huber"])
def test_a_fold_without_weight_is_a_fold_that_is_not_there(mission, method, robust):
    """Cross-validation takes the weights away, not the samples: the same estimate to the rounding of its sums."""
    estimator, settings = ESTIMATORS[method], FitSettings(robust)
    names = ("temperature",) if estimator.takes_regressors else ()
    o = _observations(mission, True).with_regressors(names)
    o = replace(o, rate_nt_s=np.zeros((0, 0)))
    near = estimator.fit(o, settings)
    for fold in folds_of(o.t_s)[:2]:
        weights, rest = o.weights.copy(), np.ones(len(o), dtype=bool)
        weights[fold], rest[fold] = 0.0, False
        fast = estimator.refit(replace(o, weights=weights), settings, near).vector
        slow = estimator.refit(o.take(rest), settings, near).vector
        np.testing.assert_allclose(fast, slow, rtol=1e-7, atol=1e-6)
