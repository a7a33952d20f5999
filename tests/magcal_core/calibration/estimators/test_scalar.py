"""Scalar calibration against an independent implementation's answers, planted truths and finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.estimators.scalar_kernel import accumulate, residuals
from magcal_core.errors import NotObservableError
from magcal_core.observations import Observations
from magcal_core.sensor.model import SensorModel, parameters_of_matrix
from magcal_core.sensor.parameterisation import Standardised, rows_from_theta, rows_jacobian, theta_jacobian
from magcal_core.sensor.parameters import Parameters

SCALAR = ESTIMATORS["scalar"]
PLAIN = FitSettings()


def fit(samples, settings=PLAIN, **how):
    return SCALAR.fit(Observations.of(samples, **how), settings)


def assert_close(parameters, answer, rel=1e-6):
    for mine, theirs in (("scale", "k"), ("nonorthogonality_deg", "eps_deg"), ("bias_nt", "b_nT")):
        want = np.array(answer[theirs])
        assert np.all(np.abs(getattr(parameters, mine) - want) <= rel * np.maximum(1.0, np.abs(want))), mine


@pytest.mark.parametrize("name", ["nominal", "outliers"])
def test_worked_case_is_reproduced(case, name):
    """The same minimiser, deterministic: 1e-6; the independent code needed 4 and 9 evaluations."""
    worked = case(name)
    got, want = fit(worked.samples), worked.expected["scalar_lm"]
    assert_close(got.parameters, want)
    assert np.sqrt(got.cost) == pytest.approx(want["phi"], rel=1e-10)
    errors = got.formal_standard_errors
    np.testing.assert_allclose(errors.bias_nt, want["se_b"], rtol=1e-6)
    np.testing.assert_allclose(errors.scale, want["se_k"], rtol=1e-6)
    np.testing.assert_allclose(errors.nonorthogonality_deg, want["se_eps_deg"], rtol=1e-6)
    assert got.evaluations <= want["residual_evals"]


@pytest.mark.parametrize("name", ["nominal", "outliers"])
def test_noise_aware_fit_with_known_noise_is_reproduced(case, name):
    worked = case(name)
    got = fit(worked.samples, FitSettings(noise_model="white", noise_nt=100.0))
    assert_close(got.parameters, worked.expected["scalar_geo_sigma_known"])


def test_noise_aware_fit_estimates_the_noise(mission):
    """100 nT planted; the estimate of a standard deviation from 700 samples scatters by 2.7 %."""
    got = fit(mission().samples, FitSettings(noise_model="white"))
    assert got.noise_nt == pytest.approx(100.0, rel=0.1)


@pytest.mark.parametrize("seed", range(60))
def test_hard_truth_is_found_from_the_closed_form(mission, hard_sensor, seed):
    """Noise-free: the planted sensor to rounding of fields of 1e5 nT, in at most 12 evaluations."""
    sensor = hard_sensor(seed)
    flown = mission(noise_nt=0.0, seed=seed, sensor=sensor)
    got = fit(flown.samples)
    np.testing.assert_allclose(got.parameters.bias_nt, sensor.bias_nt, atol=1e-4)
    np.testing.assert_allclose(got.parameters.scale, sensor.scale, rtol=1e-8)
    np.testing.assert_allclose(got.parameters.nonorthogonality_deg, sensor.nonorthogonality_deg, atol=1e-6)
    assert got.evaluations <= 12


@pytest.mark.parametrize("seed", range(25))
def test_any_start_ends_at_the_optimum(mission, seed):
    observations = Observations.of(mission().samples)
    best = SCALAR.fit(observations, PLAIN)
    rng = np.random.default_rng(seed)
    start = Parameters(rng.uniform(-6e4, 6e4, 3), rng.uniform(0.3, 3, 3), rng.uniform(-50, 50, 3))
    got = SCALAR.fit(observations, FitSettings(start=start))
    assert got.cost == pytest.approx(best.cost, rel=1e-9)
    np.testing.assert_allclose(got.parameters.vector, best.parameters.vector, rtol=1e-5)


@pytest.mark.parametrize("noise_nt", [0.0, 100.0])
def test_constant_magnitude_over_the_whole_sphere_is_enough(mission, noise_nt):
    """Where |B| is constant the linear start is rank deficient; the fit must not notice. 4 sigma: nine parameters."""
    flown = mission(noise_nt=noise_nt, constant_nt=40000.0, n=1000)
    got = fit(flown.samples)
    allowed = 4 * got.formal_standard_errors.vector + 1e-6
    assert np.all(np.abs(got.parameters.vector - flown.truth) <= allowed)


def test_left_handed_sensor_comes_out_right_handed(mission):
    """|B| cannot show the sign of an axis: |k2| comes back, and e1 and e3 change sign with it."""
    left = SensorModel([500.0, -300.0, 200.0], [1.02, -0.97, 1.01], [3.0, -2.0, 5.0])
    got = fit(mission(sensor=left, noise_nt=0.0).samples).parameters
    np.testing.assert_allclose(got.scale, [1.02, 0.97, 1.01], rtol=1e-9)
    np.testing.assert_allclose(got.nonorthogonality_deg, [-3.0, -2.0, -5.0], atol=1e-7)


@pytest.mark.parametrize("noise_nt", [0.0, 10.0, 100.0, 500.0])
@pytest.mark.parametrize("constant_nt", [None, 40000.0])
@pytest.mark.parametrize("motion", ["planar", "cone", "six faces", "still"])
def test_motion_that_leaves_parameters_free_is_refused(mission, motion, constant_nt, noise_nt):
    for seed in range(5):
        flown = mission(motion, noise_nt=noise_nt, constant_nt=constant_nt, seed=seed)
        with pytest.raises(NotObservableError, match=r"do not determine .* condition number") as caught:
            fit(flown.samples)
        assert caught.value.parameters


@pytest.mark.parametrize("noise_nt", [0.0, 100.0])
def test_spin_with_constant_axial_component_is_refused(mission, noise_nt):
    with pytest.raises(NotObservableError):
        fit(mission(axial_nt=15000.0, noise_nt=noise_nt).samples)


def test_all_equal_samples_and_few_samples_are_refused(mission):
    samples = mission().samples
    for index in (np.zeros(100, np.intp), np.arange(5), np.arange(9)):
        with pytest.raises(NotObservableError, match="condition number"):
            fit(samples.take(index))


def test_six_faces_name_the_angles(mission):
    with pytest.raises(NotObservableError) as caught:
        fit(mission("six faces").samples)
    assert set(caught.value.parameters) == {f"nonorthogonality_deg[{i}]" for i in range(3)}


@pytest.mark.parametrize("loss", range(5))
@pytest.mark.parametrize("sigma", [-1.0, 120.0])
@pytest.mark.parametrize("is_newton", [False, True])
def test_kernel_gradient_matches_finite_differences(mission, loss, sigma, is_newton):
    """Central differences of the cost, step 1e-6: good to about 1e-7 relative."""
    o = Observations.of(mission(n=200).samples)
    rng = np.random.default_rng(3)
    z, rate = rng.normal(size=(200, 2)), rng.normal(size=(200, 1)) * 20
    theta = np.concatenate([[1, 0.05, 0.98, 0.02, -0.1, 0.97], [2500, -1200, -1500], rng.normal(size=6) * 50, [3.0]])
    size = np.concatenate([np.full(6, 1e-6), np.full(9, 1e-2), [1e-4]])

    def cost(at):
        arrays = (o.h_nt, o.b_nt, o.weights, z, rate)
        return accumulate(*arrays, at, loss, 300.0, sigma, is_newton, np.empty((16, 16)), np.empty(16))

    gradient = np.empty(16)
    accumulate(o.h_nt, o.b_nt, o.weights, z, rate, theta, loss, 300.0, sigma, is_newton, np.empty((16, 16)), gradient)
    numeric = np.array(
        [(cost(theta + d) - cost(theta - d)) / (4 * s) for d, s in zip(np.diag(size), size, strict=True)]
    )
    np.testing.assert_allclose(gradient, numeric, rtol=2e-5, atol=1e-6 * np.abs(gradient).max())


def test_kernel_residuals_are_those_of_the_formula(mission):
    o = Observations.of(mission(n=50).samples)
    theta = np.concatenate([[1, 0.05, 0.98, 0.02, -0.1, 0.97], [2500, -1200, -1500]])
    got = np.empty(50)
    residuals(o.h_nt, o.b_nt, np.zeros((50, 0)), np.zeros((50, 0)), theta, -1.0, got)
    lower = np.array([[1, 0, 0], [0.05, 0.98, 0], [0.02, -0.1, 0.97]])
    want = np.linalg.norm(o.h_nt @ lower.T - theta[6:], axis=1) - o.b_nt
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_parameter_jacobian_matches_finite_differences():
    rng = np.random.default_rng(5)
    z = Standardised(("a", "b"), np.zeros((1, 2)), np.array([20.0, -3.0]), np.array([5.0, 2.0]))
    theta = np.concatenate([[0.9, 0.1, 1.1, -0.2, 0.3, 0.8], rng.normal(size=9) * 1000])

    def reported(at):
        matrix, bias, slopes = rows_from_theta(at, 2)
        scale, angles = parameters_of_matrix(matrix)
        per_unit = slopes / z.spread[:, None]
        return np.concatenate([bias - z.mean @ per_unit, scale, np.rad2deg(angles), per_unit.ravel()])

    got = rows_jacobian(rows_from_theta(theta, 2)[0], z) @ theta_jacobian(theta, 2)
    size = np.concatenate([np.full(6, 1e-6), np.full(9, 1e-2)])
    numeric = np.stack(
        [(reported(theta + d) - reported(theta - d)) / (2 * s) for d, s in zip(np.diag(size), size, strict=True)]
    )
    np.testing.assert_allclose(got, numeric.T, rtol=1e-6, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("robust", ["huber", "soft_l1", "cauchy", "tukey"])
@pytest.mark.parametrize("noise_model", ["none", "white"])
def test_spikes_and_a_jump_move_no_parameter_by_a_sigma(mission, robust, noise_model):
    """5 % spikes of up to 20 uT and one jump of a minute: against the same data without them.

    Redescending losses forget an outlier, convex ones keep a bounded rest of its pull: 2 sigma for them.
    """
    clean = mission(seed=8).samples
    rng = np.random.default_rng(8)
    h = clean.h_nt.copy()
    struck = rng.choice(700, 35, replace=False)
    h[struck, rng.integers(0, 3, 35)] += rng.uniform(-2e4, 2e4, 35)
    h[300:306] += 5000.0
    before, after = fit(clean), fit(replace(clean, h_nt=h), FitSettings(robust, noise_model))
    moved = np.abs(after.parameters.vector - before.parameters.vector) / before.formal_standard_errors.vector
    assert moved.max() < (1.0 if robust in ("cauchy", "tukey") else 2.0)
