"""Closed forms of probabilities against `scipy.special`."""

import numpy as np
import pytest
from scipy.special import chdtrc, ndtr, ndtri

from magcal_core.calibration.terms.clock import SIGNIFICANCE, ClockTest
from magcal_core.numerics.tails import chi_square_of_three, deviations_of_mixtures, normal_two_sided

TOLERANCE = 5e-13
"""Far out the rounding of the argument, 1e-16, is multiplied by x^2 on either side: by 900 at 30 sigma."""


@pytest.mark.parametrize("sigmas", [0.0, 1e-9, -0.3, 1.0, 1.96, -4.7, 12.0, 30.0])
def test_two_sided_normal_is_scipys(sigmas: float) -> None:
    np.testing.assert_allclose(normal_two_sided(sigmas), 2.0 * ndtr(-abs(sigmas)), rtol=TOLERANCE)


@pytest.mark.parametrize("statistic", [0.0, 1e-6, 0.5, 2.37, 7.81, 40.0, 700.0])
def test_chi_square_of_three_is_scipys(statistic: float) -> None:
    np.testing.assert_allclose(chi_square_of_three(statistic), chdtrc(3, statistic), rtol=TOLERANCE)


def test_detectable_offset_is_that_of_a_two_sided_test_with_power_of_95_percent() -> None:
    sigmas = -(ndtri(SIGNIFICANCE / 2.0) + ndtri(0.05))
    np.testing.assert_allclose(ClockTest(0.0, 2.0).detectable_s, 2.0 * sigmas, rtol=1e-15)


def test_a_mixture_of_one_law_has_its_deviation() -> None:
    found = deviations_of_mixtures(np.ones((1, 2)), np.array([[3.0, 1e-4]]), 9)
    np.testing.assert_allclose(found, [3.0, 1e-4], rtol=1e-15)


def test_deviations_of_mixtures_leave_what_scipy_says_beyond_them() -> None:
    """Nine halvings of a bracket of a factor of 100 leave steps of a hundredth, and the line through one 1e-4 of it."""
    rng = np.random.default_rng(5)
    weights = rng.dirichlet(np.full(40, 0.2), 6).T
    deviations = np.exp(rng.uniform(0.0, np.log(100.0), (40, 6)))
    found = deviations_of_mixtures(np.ascontiguousarray(weights), deviations, 9)
    left = np.sum(weights * ndtr(-1.96 * found / deviations), axis=0)
    np.testing.assert_allclose(left, 0.025, rtol=2e-4)
    exact = deviations_of_mixtures(np.ascontiguousarray(weights), deviations, 60)
    np.testing.assert_allclose(np.sum(weights * ndtr(-1.96 * exact / deviations), axis=0), 0.025, rtol=1e-12)
