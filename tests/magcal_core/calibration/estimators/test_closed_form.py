"""The Lagrange paper's candidates against exact fractions, and its errors shown."""

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from magcal_core.calibration.estimators.closed_form_rows import InverseRows
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.observations import Observations
from magcal_core.samples import Samples

PLAIN = FitSettings()
CLOSED_FORM = ESTIMATORS["vector-closed-form"]


def fit(samples, settings=PLAIN):
    return CLOSED_FORM.fit(Observations.of(samples), settings)


@pytest.fixture(scope="module")
def exact(data_dir):
    return json.loads((data_dir / "calibration" / "exact_small.json").read_text())


@pytest.fixture(scope="module")
def exact_fit(exact):
    t_utc = np.datetime64("2022-01-01", "ns") + np.arange(8) * np.timedelta64(1, "s")
    samples = Samples(t_utc, np.array(exact["h"], float), b_ref_base_nt=np.array(exact["B"], float))
    return fit(samples)


def test_integers_give_the_exact_fractions(exact, exact_fit):
    ols = {name: float(Fraction(value)) for name, value in exact["ols"].items()}
    alpha2 = ols["s_alpha2beta3"] / np.hypot(1, ols["alpha3"])
    alphas = np.array([ols["alpha1"], alpha2, ols["alpha3"]])
    betas = np.hypot(1, alphas)
    p = exact_fit.parameters
    np.testing.assert_allclose(np.tan(np.deg2rad(p.nonorthogonality_deg)), alphas, rtol=1e-9)
    np.testing.assert_allclose(p.bias_nt, [ols["b1"], ols["b2"], ols["b3"]], rtol=1e-9)
    gammas = [ols["gamma1"], ols["p2_beta1gamma2"] / betas[0], ols["p3_beta2beta3gamma3"] / (betas[1] * betas[2])]
    np.testing.assert_allclose(1 / p.scale, gammas, rtol=1e-9)
    assert exact_fit.cost == pytest.approx(float(Fraction(exact["phi_ols"])), rel=1e-9)


def test_all_four_candidates_are_exact(exact, exact_fit):
    assert [c.roots for c in exact_fit.candidates] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    for got, want in zip(exact_fit.candidates, exact["candidates_float"], strict=True):
        np.testing.assert_allclose(1 / got.parameters.scale, want["gamma"], rtol=1e-9)
        np.testing.assert_allclose(np.tan(np.deg2rad(got.parameters.nonorthogonality_deg)), want["alpha"], rtol=1e-9)
        np.testing.assert_allclose(got.parameters.bias_nt, want["b"], rtol=1e-9)
        assert got.cost == pytest.approx(want["phi"], rel=1e-9)
    assert [c.is_selected for c in exact_fit.candidates] == [False, False, False, True]


def test_only_the_least_squares_candidate_is_stationary(exact_fit):
    """The theorem of four solutions is false: three candidates solve none of the paper's own equations."""
    assert [c.is_stationary for c in exact_fit.candidates] == [False, False, False, True]
    assert exact_fit.candidates[0].spread["gamma2"] == pytest.approx(1 - 0.3374507778707231 / 0.9753924181475822)
    assert exact_fit.candidates[3].spread["gamma2"] < 1e-12


@pytest.mark.parametrize("name", ["nominal", "outliers"])
def test_worked_case_is_reproduced(case, name):
    worked = case(name)
    got, want = fit(worked.samples), worked.expected["ols_inverse"]
    np.testing.assert_allclose(got.parameters.scale, want["k"], rtol=1e-10)
    np.testing.assert_allclose(got.parameters.nonorthogonality_deg, want["eps_deg"], rtol=1e-10)
    np.testing.assert_allclose(got.parameters.bias_nt, want["b_nT"], rtol=1e-10)
    for mine, theirs in zip(got.candidates, worked.expected["paper_closed_form"]["candidates"], strict=True):
        np.testing.assert_allclose(mine.parameters.scale, theirs["k"], rtol=1e-9)
        assert mine.cost == pytest.approx(theirs["phi"], rel=1e-9)
    assert not got.warnings


def test_field_that_sums_to_zero_leaves_extra_roots_undefined_and_the_estimate_sound(mission):
    """Sigma B = 0: the printed formulas are 0/0; the estimate does not use them."""
    half = mission(n=300, noise_nt=0.0)
    b = np.vstack([half.samples.b_ref_base_nt, -half.samples.b_ref_base_nt])
    t_utc = np.datetime64("2022-01-01", "ns") + np.arange(600) * np.timedelta64(1, "s")
    got = fit(Samples(t_utc, half.sensor.apply(b), b_ref_base_nt=b))
    np.testing.assert_allclose(got.parameters.vector, half.truth, rtol=1e-9)
    assert all("sums to zero" in c.undefined for c in got.candidates if c.undefined)
    assert sum(c.undefined is not None for c in got.candidates) == 4


def test_small_field_spread_costs_the_raw_sums_their_digits_and_not_the_estimate(mission):
    """Spread 1e-3 of |B|: raw sums keep about four digits, centred QR thirteen."""
    flown = mission(noise_nt=0.0)
    b = 40000.0 * np.array([0.6, 0.5, 0.62]) + 1e-3 * flown.samples.b_ref_base_nt
    samples = replace(
        flown.samples, h_nt=flown.sensor.apply(b), b_ref_base_nt=b, b_ref_magnitude_nt=np.linalg.norm(b, axis=1)
    )
    got = fit(samples)
    np.testing.assert_allclose(got.parameters.scale, flown.sensor.scale, rtol=1e-8)
    assert [w for w in got.warnings if w.startswith("closed_form_inaccurate")]


def test_attenuation_is_the_predicted_one_and_white_noise_model_removes_it(mission):
    """k1 -> k1 / lambda1, lambda = V/(V + sigma^2/t^2), 20,000 samples of 2000 nT noise: 4 standard errors."""
    flown = mission(n=20000, noise_nt=2000.0)
    plain = fit(flown.samples)
    spread = flown.samples.b_ref_base_nt[:, 0].var()
    predicted = flown.sensor.scale[0] * (1 + (2000.0 / flown.sensor.scale[0]) ** 2 / spread)
    error = plain.formal_standard_errors.scale[0]
    assert plain.parameters.scale[0] == pytest.approx(predicted, abs=4 * error)
    assert plain.parameters.scale[0] - flown.sensor.scale[0] > 10 * error
    mended = fit(flown.samples, FitSettings(noise_model="white", noise_nt=2000.0))
    off = np.abs(mended.parameters.vector - flown.truth) / mended.formal_standard_errors.vector
    assert off.max() < 4.0


def rows_of(unknowns):
    """The rows at unknowns row by row: what is below, the gain, the intercept."""
    below = np.zeros((3, 3))
    below[1, 0], below[2, 0], below[2, 1] = unknowns[[2, 5, 6]]
    one, none = np.ones(1), np.zeros((1, 3))
    return InverseRows(none, none, unknowns[[0, 3, 7]], below, unknowns[[1, 4, 8]], none, np.ones(3), one)


def test_the_derivatives_of_matrix_and_bias_are_those_of_differences():
    """Central differences of a smooth function by 1e-6 of each unknown: right to 1e-9 of the derivative."""
    at = np.array([1.3, 900.0, 0.2, -0.8, -1500.0, -0.1, 0.3, 1.7, 400.0])
    jacobian = rows_of(at).jacobian()
    for column, value in enumerate(at):
        step = 1e-6 * abs(value) * np.eye(9)[column]
        later, sooner = rows_of(at + step), rows_of(at - step)
        change = [(later.matrix - sooner.matrix)[np.tril_indices(3)], later.bias_nt - sooner.bias_nt]
        expected = np.concatenate(change) / (2e-6 * abs(value))
        np.testing.assert_allclose(jacobian[:, column], expected, rtol=1e-8, atol=1e-9)
