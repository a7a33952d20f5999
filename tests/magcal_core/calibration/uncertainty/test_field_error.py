"""The error of the corrected field that a covariance allows, against draws from that covariance."""

import numpy as np
import pytest

from magcal_core.calibration.uncertainty.field_error import FIELD_NT, field_error, field_error_of_matrix
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters

AT = Parameters(np.array([2000.0, -1500.0, 800.0]), np.array([1.1, 0.9, 1.02]), np.array([3.0, -4.0, 5.0]))


@pytest.fixture(scope="module")
def covariance():
    rng = np.random.default_rng(5)
    size = np.array([80.0, 60.0, 90.0, 2e-3, 3e-3, 1e-3, 0.1, 0.2, 0.05])
    mixed = rng.normal(size=(9, 9))
    return (mixed @ mixed.T / 9.0) * np.outer(size, size)


def test_two_deviations_of_draws_along_the_worst_direction(covariance):
    """4000 draws: root mean square along the axis of the largest error there, to 3 %."""
    found = field_error(AT, covariance)
    truth = SensorModel(AT.bias_nt, AT.scale, AT.nonorthogonality_deg)
    h_nt = truth.apply(FIELD_NT * found.direction[None])
    rng = np.random.default_rng(1)
    off = []
    for draw in rng.multivariate_normal(AT.vector, covariance, 4000):
        sensor = SensorModel(draw[:3], draw[3:6], draw[6:9])
        off.append(sensor.correct(h_nt)[0] - FIELD_NT * found.direction)
    largest = np.linalg.eigvalsh(np.cov(np.array(off).T))[-1]
    assert found.share == pytest.approx(2.0 * np.sqrt(largest) / FIELD_NT, rel=0.03)


def test_nothing_known_is_infinite_and_the_largest_part_is_named(covariance):
    assert field_error(AT, np.full((9, 9), np.inf)).share == np.inf
    of_bias = np.zeros((9, 9))
    of_bias[0, 0] = 400.0**2
    found = field_error(AT, of_bias)
    assert found.largest == "bias"
    assert found.share == pytest.approx(2.0 * 400.0 / FIELD_NT, rel=0.2)


def test_all_nine_elements_of_a_matrix():
    """T the unit matrix, an error of T12 alone: at its largest where the field lies along the second axis."""
    covariance = np.zeros((12, 12))
    covariance[1, 1] = 0.005**2
    found = field_error_of_matrix(np.eye(3), covariance)
    assert found.share == pytest.approx(0.01, rel=0.02)
    assert abs(found.direction[1]) > 0.99
    assert found.largest == "matrix"
