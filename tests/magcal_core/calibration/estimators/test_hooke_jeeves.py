"""The DEKART paper's search against Levenberg-Marquardt and against an independent implementation of it."""

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import NotObservableError, OptionError
from magcal_core.observations import Observations
from magcal_core.sensor.conventions import convert

SEARCH, SCALAR = ESTIMATORS["scalar-hooke-jeeves"], ESTIMATORS["scalar"]


@pytest.mark.parametrize("name", ["nominal", "outliers"])
def test_worked_case_is_reproduced(case, name):
    """The independent search stopped at steps of 1e-6: its own numbers are good to 1e-4."""
    worked = case(name)
    got, want = (
        SEARCH.fit(Observations.of(worked.samples), FitSettings()),
        worked.expected["hooke_jeeves_first_order_A"],
    )
    assert np.sqrt(got.cost) <= worked.expected["scalar_lm"]["phi"] * (1 + 1e-4)
    first = got.extras["first_order"]
    np.testing.assert_allclose(first["scale"], want["first_order"]["k"], atol=1e-5)
    np.testing.assert_allclose(first["nonorthogonality_deg"], want["first_order"]["eps_deg"], atol=1e-3)
    np.testing.assert_allclose(got.parameters.scale, want["converted_exact"]["k"], atol=1e-5)
    np.testing.assert_allclose(got.parameters.nonorthogonality_deg, want["converted_exact"]["eps_deg"], atol=1e-3)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("noise_nt", [0.0, 300.0])
def test_cost_is_that_of_levenberg_marquardt_on_hard_sensors(mission, hard_sensor, seed, noise_nt):
    """Within 1e-4 of the root of the cost, as asked; noise-free within a millionth of a nT a sample."""
    observations = Observations.of(mission(seed=seed, sensor=hard_sensor(seed), noise_nt=noise_nt).samples)
    found, best = SEARCH.fit(observations, FitSettings()), SCALAR.fit(observations, FitSettings())
    assert np.sqrt(found.cost) <= np.sqrt(best.cost) * (1 + 1e-4) + 1e-2 * np.sqrt(len(observations))


@pytest.mark.parametrize(("robust", "noise_model"), [("tukey", "none"), ("none", "white"), ("huber", "white")])
def test_losses_and_noise_model_are_those_of_the_scalar_fit(case, robust, noise_model):
    observations, settings = Observations.of(case("outliers").samples), FitSettings(robust, noise_model)
    found, best = SEARCH.fit(observations, settings), SCALAR.fit(observations, settings)
    np.testing.assert_allclose(found.parameters.vector, best.parameters.vector, rtol=1e-3)


def test_first_order_parameters_and_exact_ones_say_the_same(case):
    got = SEARCH.fit(Observations.of(case("nominal").samples), FitSettings())
    exact = convert(got.extras["first_order"], "first-order", "exact")
    np.testing.assert_allclose(exact["scale"], got.parameters.scale, rtol=1e-12)
    np.testing.assert_allclose(exact["nonorthogonality_deg"], got.parameters.nonorthogonality_deg, rtol=1e-11)


def test_statistics_are_the_papers_model_minus_measured(case):
    got = SEARCH.fit(Observations.of(case("nominal").samples), FitSettings())
    first = got.extras["first_order"]
    assert first["mean_nt"] == pytest.approx(-got.residuals_nt.mean())
    assert first["sigma_nt"] == pytest.approx(got.residuals_nt.std())


def test_what_the_paper_does_not_have_is_refused(mission):
    observations = Observations.of(mission().samples, ["time"])
    with pytest.raises(OptionError):
        SEARCH.fit(observations, FitSettings())


def test_planar_motion_is_refused(mission):
    with pytest.raises(NotObservableError):
        SEARCH.fit(Observations.of(mission("planar").samples), FitSettings())
