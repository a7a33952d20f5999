"""A scale that changes with temperature: its slopes are found, with honest errors, and taken off everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from magcal_core.calibration.sessions.monitoring import ActiveSet, judge_session
from magcal_core.errors import NotObservableError, OptionError
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import matrix_of_parameters
from magcal_core.sessions import calibrate_jointly, monitor
from magcal_core.simulation.telemetry import simulate

SLOPES = np.array([4e-4, -6e-4, 3e-4])
DRIFT_NT = np.array([5.0, -8.0, 3.0])
TERMS = ("temperature", "temperature*h")


def warmed(mission, seed, n=1400, noise_nt=60.0):
    """A mission whose bias and scale follow a temperature that swings by 15 K, once in 5900 s."""
    made = mission(seed=seed, n=n, noise_nt=noise_nt)
    t_s = (made.samples.t_utc - made.samples.t_utc[0]) / np.timedelta64(1, "s")
    temperature = 5.0 + 15.0 * np.sin(2 * np.pi * t_s / 5900.0 + seed)
    h_nt = (made.samples.h_nt + temperature[:, None] * DRIFT_NT) / (1.0 - temperature[:, None] * SLOPES)
    truth = np.concatenate([made.truth, DRIFT_NT, SLOPES])
    return replace(made.samples, h_nt=h_nt, housekeeping={"temperature": temperature}), truth


@pytest.mark.parametrize("method", ["scalar", "vector"])
@pytest.mark.parametrize("robust", ["none", "huber"])
def test_intervals_of_all_fifteen_parameters_hold_the_truth(mission, method, robust):
    """Eight sessions: scores of unit variance have a mean square of 0.6 to 1.5 over 120 correlated ones, here below."""
    scores = []
    for seed in range(8):
        samples, truth = warmed(mission, seed)
        got = calibrate(samples, method=method, robust=robust, regressors=TERMS)
        assert got.parameters.names[12:] == tuple(f"regressors.temperature*h[{i}]" for i in range(3))
        scores.append((got.parameters.vector - truth) / got.standard_errors.vector)
        assert got.after.rms_nt == pytest.approx(60.0, rel=0.1)
    assert np.mean(np.square(scores)) < 1.5
    assert np.mean(np.abs(scores) < 1.96) > 0.9
    assert np.all(np.std(scores, axis=0) > 0.2)


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_without_noise_the_slopes_are_exact(mission, method):
    """To what double precision leaves of readings of 4e4 nT at a condition of some 1e3."""
    samples, truth = warmed(mission, 3, noise_nt=0.0)
    got = calibrate(samples, method=method, regressors=TERMS)
    np.testing.assert_allclose(got.parameters.vector[9:], truth[9:], rtol=1e-7)
    np.testing.assert_allclose(got.parameters.vector[:9], truth[:9], rtol=1e-7, atol=1e-7)
    assert np.abs(got.residuals.residual_nt).max() < 1e-5


def test_estimate_and_covariance_are_those_of_a_search_over_all_fifteen_at_once(mission):
    """SciPy's least squares of |T^-1 (h (1 - m x) - b - c x)| - |B|: the same minimum, and (J^T J)^-1 from its J."""
    samples, truth = warmed(mission, 5)
    x = samples.housekeeping["temperature"][:, None]
    unit = np.array([100.0] * 3 + [1e-2] * 3 + [1.0] * 3 + [1.0] * 3 + [1e-4] * 3)

    def residual(scaled):
        p = scaled * unit
        inverse = np.linalg.inv(matrix_of_parameters(p[3:6], np.deg2rad(p[6:9])))
        h_nt = samples.h_nt * (1.0 - p[12:] * x) - p[:3] - p[9:12] * x
        return np.linalg.norm(h_nt @ inverse.T, axis=1) - samples.b_ref_magnitude_nt

    found = least_squares(residual, truth / unit, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / (len(x) - 15)
    errors = np.sqrt(np.diag(covariance)) * unit
    got = calibrate(samples, regressors=TERMS)
    np.testing.assert_allclose((got.parameters.vector - found.x * unit) / errors, 0.0, atol=1e-4)
    np.testing.assert_allclose(got.formal_standard_errors.vector, errors, rtol=0.01)
    correlation = covariance / np.outer(*2 * [np.sqrt(np.diag(covariance))])
    assert np.abs(correlation[:9, 12:]).max() > 0.1


def test_blocks_that_are_left_out_are_fitted_with_slopes_of_their_own(mission):
    samples, _ = warmed(mission, 2)
    with_terms = calibrate(samples, regressors=TERMS)
    without = calibrate(samples, regressors=("temperature",))
    assert with_terms.cross_validated_rms_nt < 1.05 * with_terms.after.rms_nt
    assert with_terms.cross_validated_rms_nt < 0.8 * without.cross_validated_rms_nt
    selected = [row for row in with_terms.extras["ablation"] if row["selected"]]
    assert [row["regressors"] for row in selected] == [list(TERMS)]


def test_the_residual_table_takes_the_terms_off_every_sample(mission):
    """A sample that is left out has its residual under the same parameters."""
    samples, _ = warmed(mission, 1)
    flags = samples.flags.copy()
    flags[10] = 1
    got = calibrate(replace(samples, flags=flags), regressors=TERMS)
    assert got.residuals.weight[10] == 0.0
    assert abs(got.residuals.residual_nt[10]) < 300.0


@pytest.mark.parametrize("offset_s", [0.0, 2.0])
def test_the_clock_is_found_beside_the_slopes(mission, data_dir, offset_s):
    """Within four of its own standard errors, as all fifteen parameters are."""
    orbit = Sgp4Orbit(parse_tles((data_dir / "dekart.tle.txt").read_text())[0])
    sensor = mission().sensor
    made = simulate(orbit, sensor, orbit.epoch_utc, 11500.0, 10.0, seed=4)
    t_s = (made.samples.t_utc - made.samples.t_utc[0]) / np.timedelta64(1, "s")
    x = 5.0 + 15.0 * np.sin(t_s / 800.0)[:, None]
    noise_nt = 30.0 * np.random.default_rng(8).normal(size=made.samples.h_nt.shape)
    h_nt = (made.samples.h_nt + noise_nt + DRIFT_NT * x) / (1.0 - SLOPES * x)
    moved = made.samples.t_utc - np.timedelta64(round(offset_s * 1e9), "ns")
    samples = replace(made.samples, h_nt=h_nt, t_utc=moved, housekeeping={"temperature": x[:, 0]})
    got = calibrate(samples, [orbit], regressors=TERMS, time_offset="estimate")
    truth = np.concatenate([sensor.bias_nt, sensor.scale, sensor.nonorthogonality_deg, DRIFT_NT, SLOPES, [offset_s]])
    scores = (got.parameters.vector - truth) / got.standard_errors.vector
    assert np.abs(scores).max() < 4.0
    assert got.parameters.names[-1] == "time_offset_s"


def test_a_session_is_judged_under_the_terms_of_the_set_in_force(mission):
    samples, _ = warmed(mission, 1)
    record = calibrate(samples, regressors=TERMS).to_dict()
    again, _ = warmed(mission, 2)
    judged = monitor(again, [], record)
    assert judged.grade == "agrees"
    assert judged.residual_ratio == pytest.approx(1.0, abs=0.1)
    shifted = replace(again, h_nt=again.h_nt * np.array([1.03, 1.0, 1.0]))
    assert monitor(shifted, [], record).grade == "disagrees"
    observed = Observations.of(again, TERMS)
    assert judge_session(observed, ActiveSet.from_record(record)).grade == "agrees"


def test_what_cannot_have_them_says_so(mission):
    samples, _ = warmed(mission, 1)
    still = replace(samples, housekeeping={"temperature": np.full(len(samples), 20.0)})
    with pytest.raises(OptionError, match="cannot be told from the scale"):
        calibrate(still, regressors=("temperature*h",))
    with pytest.raises(OptionError, match="no housekeeping column 'warmth'"):
        calibrate(samples, regressors=("warmth*h",))
    with pytest.raises(OptionError, match="takes no regressors"):
        calibrate(samples, method="scalar-hooke-jeeves", regressors=TERMS)
    with pytest.raises(OptionError, match="not those of the scale"):
        calibrate_jointly({"a": samples, "b": samples}, (), CalibrationOptions(regressors=TERMS))
    keeping = samples.housekeeping
    twice = replace(samples, housekeeping={**keeping, "same": keeping["temperature"] * 2.0})
    with pytest.raises(NotObservableError, match="scale"):
        calibrate(twice, regressors=("temperature*h", "same*h"))
