"""Forward maximum likelihood against an independent implementation, planted truths and its degenerate inputs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import (
    CoplanarFieldError,
    DeadAxisError,
    FrameError,
    NoExcitationError,
    TelemetryValueError,
    TooFewSamplesError,
    UnitsError,
)
from magcal_core.observations import Observations
from magcal_core.sensor.model import SensorModel

VECTOR = ESTIMATORS["vector"]
PLAIN = FitSettings()
METHODS = ["vector", "vector-closed-form"]


def fit(samples, method="vector", settings=PLAIN):
    return ESTIMATORS[method].fit(Observations.of(samples), settings)


@pytest.mark.parametrize("name", ["nominal", "outliers"])
def test_worked_case_is_reproduced(case, name):
    worked = case(name)
    got, want = fit(worked.samples), worked.expected["forward_ml"]
    np.testing.assert_allclose(got.parameters.scale, want["k"], rtol=1e-10)
    np.testing.assert_allclose(got.parameters.nonorthogonality_deg, want["eps_deg"], rtol=1e-10)
    np.testing.assert_allclose(got.parameters.bias_nt, want["b_nT"], rtol=1e-10)
    errors = got.formal_standard_errors
    np.testing.assert_allclose(errors.scale, want["se_k"], rtol=1e-9)
    np.testing.assert_allclose(errors.nonorthogonality_deg, want["se_eps_deg"], rtol=1e-9)
    np.testing.assert_allclose(errors.bias_nt, want["se_b"], rtol=1e-9)


def test_robust_fit_rejects_the_planted_outliers(case):
    worked = case("outliers")
    got = fit(worked.samples, settings=FitSettings("tukey"))
    planted = set(worked.answer["outlier_indices"])
    assert {int(i) for i in np.flatnonzero(got.weights < 0.05)} >= planted
    want = worked.answer["truth"]
    moved = [
        (got.parameters.bias_nt - want["b_nT"]) / got.formal_standard_errors.bias_nt,
        (got.parameters.scale - want["k"]) / got.formal_standard_errors.scale,
        (got.parameters.nonorthogonality_deg - want["eps_deg"]) / got.formal_standard_errors.nonorthogonality_deg,
    ]
    assert np.abs(moved).max() < 3.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("robust", ["huber", "tukey"])
def test_formal_errors_under_a_loss_are_the_scatter(mission, method, robust):
    """40 missions of white noise x 9 parameters: (estimate - truth) / error has a root mean square of 1.

    To 12 %: three times 1 / sqrt(2 x 360). One residual of three decides a weight; were all three taken for capped with
    it, the errors would be 1.4 times too large.
    """
    flown = [mission(n=300, noise_nt=60.0, seed=seed) for seed in range(40)]
    fits = [fit(one.samples, method, FitSettings(robust)) for one in flown]
    away = [
        (f.parameters.vector - one.truth) / np.sqrt(np.diag(f.covariance)) for f, one in zip(fits, flown, strict=True)
    ]
    assert np.sqrt(np.mean(np.square(away))) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("method", METHODS)
def test_left_handed_sensor_keeps_its_sign_and_is_warned_of(mission, method):
    left = SensorModel([500.0, -300.0, 200.0], [1.02, -0.97, 1.01], [3.0, -2.0, 5.0])
    got = fit(mission(sensor=left, noise_nt=0.0).samples, method)
    np.testing.assert_allclose(got.parameters.scale, left.scale, rtol=1e-12)
    np.testing.assert_allclose(got.parameters.nonorthogonality_deg, left.nonorthogonality_deg, atol=1e-9)
    assert [w for w in got.warnings if w.startswith("inverted_axis: axis 2")]


def test_axis_near_ninety_degrees_is_found_and_warned_of(mission):
    """89.9 deg with 100 nT of noise: the forward fit is good to 0.02 deg, the inverse one is off by a degree."""
    skewed = SensorModel([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [89.9, 0.0, 0.0])
    samples = mission(sensor=skewed, n=1150).samples
    got = fit(samples)
    assert got.parameters.nonorthogonality_deg[0] == pytest.approx(89.9, abs=0.03)
    assert [w for w in got.warnings if w.startswith("skewed_axis: e1")]
    assert fit(samples, "vector-closed-form").parameters.nonorthogonality_deg[0] < 89.5


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("noise_nt", [0.0, 100.0])
class TestDegenerateInputs:
    """Noise makes any reading full rank: what is missing must be seen on the field."""

    def test_constant_component_is_named(self, mission, method, noise_nt):
        flown = mission(noise_nt=0.0)
        noise = noise_nt * np.random.default_rng(1).normal(size=(700, 3))
        for axis in range(3):
            b = flown.samples.b_ref_base_nt.copy()
            b[:, axis] = 21000.0
            with pytest.raises(NoExcitationError, match=f"axis {axis + 1}"):
                fit(replace(flown.samples, h_nt=flown.sensor.apply(b) + noise, b_ref_base_nt=b), method)

    def test_coplanar_field_gives_its_normal(self, mission, method, noise_nt):
        flown = mission(noise_nt=0.0)
        noise = noise_nt * np.random.default_rng(1).normal(size=(700, 3))
        b = flown.samples.b_ref_base_nt.copy()
        b[:, 2] = 5000.0 + 0.5 * b[:, 0] - 0.25 * b[:, 1]
        normal = np.array([-0.5, 0.25, 1.0]) / np.linalg.norm([0.5, 0.25, 1.0])
        with pytest.raises(CoplanarFieldError, match=", ".join(f"{x:.4f}" for x in normal)):
            fit(replace(flown.samples, h_nt=flown.sensor.apply(b) + noise, b_ref_base_nt=b), method)

    def test_dead_axis_is_named(self, mission, method, noise_nt):
        flown = mission(noise_nt=noise_nt)
        for axis in range(3):
            h = flown.samples.h_nt.copy()
            h[:, axis] = 1000.0 + noise_nt * np.random.default_rng(2).normal(size=700)
            with pytest.raises(DeadAxisError, match=f"axis {axis + 1}"):
                fit(replace(flown.samples, h_nt=h), method)

    def test_too_few_samples_are_counted(self, mission, method, noise_nt):
        with pytest.raises(TooFewSamplesError, match="4 usable samples"):
            fit(mission(n=4, noise_nt=noise_nt).samples, method)


@pytest.mark.parametrize("method", METHODS)
def test_axis_that_points_elsewhere_is_not_called_dead(mission, method):
    """Axes 1 and 3 exchanged: no axis is dead, the frame is wrong."""
    samples = mission().samples
    with pytest.raises(FrameError, match="turned by"):
        fit(replace(samples, h_nt=samples.h_nt[:, [2, 0, 1]]), method)


def test_missing_attitude_is_said(mission):
    with pytest.raises(TelemetryValueError, match="attitude"):
        fit(replace(mission().samples, b_ref_base_nt=None))


@pytest.mark.parametrize("method", sorted(ESTIMATORS))
@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "uT"), (1e-5, "G"), (1e-2, "mG"), (1e-9, "T")])
def test_wrong_unit_is_refused_by_name(mission, method, factor, unit):
    samples = mission().samples
    with pytest.raises(UnitsError, match=unit):
        fit(replace(samples, h_nt=samples.h_nt * factor), method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("robust", ["none", "tukey"])
def test_rotated_reference_is_found_and_warned_of(mission, method, robust):
    """3 deg between the reference's frame and the sensor's: T = T_low R, R by LQ, tested."""
    flown = mission(n=1150)
    turn = np.deg2rad(3.0)
    rotation = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    turned = replace(flown.samples, b_ref_base_nt=flown.samples.b_ref_base_nt @ rotation)
    got = fit(turned, method, FitSettings(robust))
    assert got.full_matrix.is_misaligned
    full = got.extras["full_matrix"]
    assert full["rotation_deg"] == pytest.approx(3.0, abs=0.05)
    assert full["p_value"] < 1e-9
    np.testing.assert_allclose(full["lower_triangular"], flown.sensor.matrix, atol=2e-3)
    assert [w for w in got.warnings if w.startswith("misaligned")]


@pytest.mark.parametrize("method", METHODS)
def test_aligned_reference_is_not_suspected(mission, method):
    """p is uniform where the hypothesis holds: ten missions all above 0.001."""
    for seed in range(10):
        assert fit(mission(seed=seed).samples, method).extras["full_matrix"]["p_value"] > 1e-3


def test_the_test_of_the_axes_is_the_f_test_of_nested_regressions(mission):
    """Against least squares of numpy: row i on its first i components, then on all three."""
    samples = mission(seed=3).samples
    field = np.column_stack([samples.b_ref_base_nt, np.ones(len(samples))])
    ratios = []
    for axis in range(3):
        squares = [
            float(np.linalg.lstsq(field[:, columns], samples.h_nt[:, axis], rcond=None)[1][0])
            for columns in ([*range(axis + 1), 3], [0, 1, 2, 3])
        ]
        ratios.append((squares[0] - squares[1]) / (squares[1] / (len(samples) - 4)))
    found = fit(samples).extras["full_matrix"]
    assert found["f_statistic"] == pytest.approx(sum(ratios) / 3.0, rel=1e-6)
    assert found["p_value"] == pytest.approx(stats.f.sf(sum(ratios) / 3.0, 3, 3 * (len(samples) - 4)), rel=1e-6)
