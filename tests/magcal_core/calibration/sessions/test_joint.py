"""Joint fits against separate and pooled ones; sessions that differ must be told, those that do not must not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.normal_equations import equations_at
from magcal_core.calibration.estimators.scalar import ScalarFit
from magcal_core.calibration.estimators.vector import VectorFit
from magcal_core.calibration.sessions.consistency import SessionEstimate, consistency, consistency_of_fits
from magcal_core.calibration.sessions.joint import joint_fit
from magcal_core.errors import NotObservableError, OptionError
from magcal_core.observations import Observations, residuals_nt
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.sensor.conventions import convert
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.telemetry import Disturbances, simulate

# DEKART, Tables 1 and 2 (Trudy MAI 2022, no. 124): first-order parameters as printed.
TABLE_1 = {
    "bias_nt": [2928.125, -1191.25, -1875.625],
    "scale": [1.032695, 1.006685, 1.032875],
    "nonorthogonality_deg": [-4.53, -1.067, 7.915],
}
TABLE_2 = {
    "bias_nt": [2807.5, -2056.25, -2070.625],
    "scale": [1.024175, 0.988788, 1.026907],
    "nonorthogonality_deg": [-4.22, -2.133, 8.504],
}


def sensor_of(table: dict[str, list[float]]) -> SensorModel:
    exact = convert(table, "first-order", "exact")
    return SensorModel(*(np.array(exact[name]) for name in ("bias_nt", "scale", "nonorthogonality_deg")))


def parameters_of(sensor: SensorModel) -> Parameters:
    return Parameters(sensor.bias_nt, sensor.scale, sensor.nonorthogonality_deg)


@pytest.fixture(scope="module")
def orbits(data_dir: Path) -> list[Sgp4Orbit]:
    lines = (data_dir / "dekart.tle.txt").read_text().splitlines()
    return [Sgp4Orbit.from_tle("\n".join(lines[i : i + 3])) for i in (0, 3)]


STARTS = [np.datetime64("2022-02-19T22:37:44.130"), np.datetime64("2022-04-07T21:42:49.300")]


def session(orbit, sensor, number: int, samples: int, seed: int, *, noise_nt: float = 60.0, **more) -> Observations:
    disturbed = Disturbances(noise_nt=noise_nt, **more)
    made = simulate(orbit, sensor, STARTS[number], samples * 10.0, 10.0, disturbances=disturbed, seed=seed)
    names = ["temperature"] if "temperature_nt_per_k" in more else []
    return Observations.of(made.samples_with_reference, names)


ONE = SensorModel(np.array([2900.0, -1200.0, -1900.0]), np.array([1.03, 1.01, 1.04]), np.array([-4.0, -1.5, 7.0]))
MOVED = replace(ONE, bias_nt=ONE.bias_nt + np.array([400.0, -300.0, 150.0]))


@pytest.mark.parametrize("is_vector", [False, True])
def test_nothing_shared_is_every_session_alone(orbits, is_vector: bool) -> None:
    """The same minimum by two routes: equal to 1e-5 standard errors or better."""
    sessions = [session(orbits[i], ONE, i, 300, seed=i) for i in (0, 1)]
    joint = joint_fit(sessions, shared=(), is_vector=is_vector)
    estimator = VectorFit() if is_vector else ScalarFit()
    for part, one in zip(joint.sessions, sessions, strict=True):
        alone = estimator.fit(one, FitSettings())
        errors = alone.formal_standard_errors.vector
        np.testing.assert_allclose((part.parameters.vector - alone.parameters.vector) / errors, 0.0, atol=1e-4)


@pytest.mark.parametrize("is_vector", [False, True])
def test_everything_shared_is_one_fit_of_all(orbits, is_vector: bool) -> None:
    """One session cut in two and put together again; the halves' own weights differ by some per cent."""
    whole = session(orbits[0], ONE, 0, 600, seed=3)
    halves = [whole.take(slice(0, 300)), whole.take(slice(300, 600))]
    shared = ("bias_nt", "scale", "nonorthogonality_deg")
    joint = joint_fit(halves, shared=shared, is_vector=is_vector)
    fit = (VectorFit() if is_vector else ScalarFit()).fit(whole, FitSettings())
    assert len(joint.names) == 9
    for part in joint.sessions:
        moved = (part.parameters.vector - fit.parameters.vector) / fit.formal_standard_errors.vector
        np.testing.assert_allclose(moved, 0.0, atol=0.3)


@pytest.mark.parametrize("is_vector", [False, True])
@pytest.mark.parametrize("robust", ["none", "huber"])
def test_own_bias_and_shared_axes_are_found_with_true_errors(orbits, is_vector: bool, robust: str) -> None:
    """Truth within 4.5 standard errors for each of 12 parameters."""
    sessions = [session(orbits[0], ONE, 0, 400, seed=5), session(orbits[1], MOVED, 1, 500, seed=6, noise_nt=150.0)]
    joint = joint_fit(sessions, ["february", "april"], is_vector=is_vector, robust=robust)
    assert joint.is_converged
    for part, truth in zip(joint.sessions, (ONE, MOVED), strict=True):
        z = (part.parameters.vector - parameters_of(truth).vector) / part.standard_errors.vector
        assert np.abs(z).max() < 4.5
        assert 0.0 < part.standard_errors.bias_nt.max() < 60.0
    assert joint.sessions[0].parameters.scale == pytest.approx(joint.sessions[1].parameters.scale, abs=0.0)
    assert joint.names[0] == "scale[0]"
    assert joint.names[-1] == "april:bias_nt[2]"
    assert joint.sessions[1].sigma_nt > 1.8 * joint.sessions[0].sigma_nt


def test_a_session_too_short_alone_is_calibrated_with_the_others_axes(orbits) -> None:
    long, short = session(orbits[0], ONE, 0, 500, seed=8), session(orbits[1], MOVED, 1, 500, seed=9).take(slice(0, 9))
    joint = joint_fit([long, short])
    found = joint.sessions[1]
    assert np.all(np.abs(found.parameters.bias_nt - MOVED.bias_nt) < 300.0)
    assert any(warning.startswith("not_observable_alone: session 2") for warning in joint.warnings)
    assert joint.consistency is None


def test_one_shared_parameter_may_be_chosen_by_name(orbits) -> None:
    sessions = [session(orbits[i], ONE, i, 300, seed=i + 10) for i in (0, 1)]
    joint = joint_fit(sessions, shared=("scale[1]",))
    assert joint.shared == ("scale[1]",)
    first, second = (part.parameters.scale for part in joint.sessions)
    assert first[1] == second[1]
    assert first[0] != second[0]
    with pytest.raises(OptionError, match="no parameter"):
        joint_fit(sessions, shared=("gain",))


def test_regressors_are_shared_or_not_like_any_parameter(orbits) -> None:
    more = {"temperature_nt_per_k": (8.0, -5.0, 3.0)}
    sessions = [session(orbits[i], ONE, i, 500, seed=i + 20, **more) for i in (0, 1)]
    joint = joint_fit(sessions, shared=("scale", "nonorthogonality_deg", "regressors"))
    for part in joint.sessions:
        z = (part.parameters.regressors["temperature"] - [8.0, -5.0, 3.0]) / part.standard_errors.regressors[
            "temperature"
        ]
        assert np.abs(z).max() < 4.5


def test_sessions_that_together_show_nothing_are_refused(orbits) -> None:
    one = session(orbits[0], ONE, 0, 300, seed=2).take(slice(0, 5))
    with pytest.raises(NotObservableError):
        joint_fit([one, one])


@pytest.mark.parametrize("is_vector", [False, True])
def test_the_equations_are_the_derivatives_of_the_cost(orbits, is_vector: bool) -> None:
    """Gradient by central differences of the cost, 1e-5 of its size."""
    o = session(orbits[0], ONE, 0, 80, seed=1)
    at = parameters_of(SensorModel(ONE.bias_nt + 50.0, ONE.scale * 1.01, ONE.nonorthogonality_deg + 0.5))
    found = equations_at(o, at, is_vector=is_vector)
    if not is_vector:
        assert found.cost == pytest.approx(np.sum(residuals_nt(o, at, is_vector) ** 2), rel=1e-12)
    steps = np.repeat([1.0, 1e-4, 1e-2], 3)
    for i, step in enumerate(steps):
        up, down = at.vector.copy(), at.vector.copy()
        up[i], down[i] = up[i] + step, down[i] - step
        costs = [equations_at(o, at.with_vector(v), is_vector=is_vector).cost for v in (up, down)]
        assert (costs[0] - costs[1]) / (4 * step) == pytest.approx(found.gradient[i], rel=1e-4, abs=1e-6 * found.cost)


# ------------------------------------------------------------------------------------------------- consistency


def test_the_published_sessions_of_dekart_disagree_by_eleven_sigma_in_b2(orbits) -> None:
    """Published: -865 nT in b2 is 11 sigma with errors of 51 to 72 nT (white residuals of 780 and 1266 nT).

    The errors come from a simulation of the two sessions: 700 and 1400 samples with such residuals.
    """
    estimates = []
    for number, (table, samples, sigma) in enumerate(((TABLE_1, 700, 780.0), (TABLE_2, 1400, 1266.0))):
        fit = ScalarFit().fit(
            session(orbits[number], sensor_of(table), number, samples, 30, noise_nt=sigma), FitSettings()
        )
        covariance = fit.covariance * (sigma / fit.sigma_nt) ** 2
        assert 35.0 < np.sqrt(np.diag(covariance))[:3].min() < np.sqrt(np.diag(covariance))[:3].max() < 100.0
        printed = Parameters(*(np.array(table[name]) for name in ("bias_nt", "scale", "nonorthogonality_deg")))
        estimates.append(SessionEstimate(f"session {number + 1}", printed, covariance))
    found = consistency(estimates)
    b2 = next(one for one in found.differences if one.parameter == "bias_nt[1]")
    assert b2.difference == pytest.approx(-865.0)
    assert 9.0 < b2.sigmas < 13.5
    assert found.differences[0].parameter == "bias_nt[1]"
    k2 = next(one for one in found.differences if one.parameter == "scale[1]")
    assert 4.5 < k2.sigmas < 8.5  # published: 6.6
    assert not found.is_consistent
    assert found.degrees_of_freedom == 9
    assert "disagree" in found.text
    assert "bias_nt[1]" in found.text


def test_simulated_sessions_of_dekart_disagree_as_the_published_ones(orbits) -> None:
    sessions = [
        session(orbits[0], sensor_of(TABLE_1), 0, 700, 31, noise_nt=780.0),
        session(orbits[1], sensor_of(TABLE_2), 1, 1400, 32, noise_nt=1266.0),
    ]
    found = consistency_of_fits(("1", "2"), [ScalarFit().fit(one, FitSettings()) for one in sessions], sessions)
    assert found is not None
    assert not found.is_consistent
    b2 = next(one for one in found.differences if one.parameter == "bias_nt[1]")
    assert b2.sigmas > 6.0  # honest errors are never smaller than the white ones, and may be half as large again


def test_one_sensor_twice_is_found_consistent(orbits) -> None:
    """Six pairs with a wave of 250 nT in the bias: at a level of 1e-3 none may be called inconsistent."""
    wave = {"wave_nt": (250.0, 0.0, 0.0)}
    for seed in range(6):
        sessions = [session(orbits[i], ONE, i, 700, 100 + 2 * seed + i, **wave) for i in (0, 1)]
        found = consistency_of_fits(("a", "b"), [ScalarFit().fit(one, FitSettings()) for one in sessions], sessions)
        assert found is not None
        assert found.is_consistent, found.text


def test_three_sessions_are_compared_pair_by_pair() -> None:
    values = Parameters(np.zeros(3), np.ones(3), np.zeros(3))
    errors = Parameters(np.full(3, 10.0), np.full(3, 0.01), np.full(3, 0.1))
    odd = replace(values, bias_nt=np.array([0.0, 0.0, 80.0]))
    found = consistency(
        [SessionEstimate.with_errors(n, p, errors) for n, p in (("a", values), ("b", values), ("c", odd))]
    )
    assert len(found.differences) == 27
    assert found.differences[0].sigmas == pytest.approx(80.0 / np.hypot(10.0, 10.0))
    # Independent: the scatter of (0, 0, 80) about its mean over the variance of one.
    assert found.chi_square == pytest.approx(np.sum((np.array([0, 0, 80.0]) - 80 / 3) ** 2) / 100.0)
    assert found.to_dict()["is_consistent"] is False
