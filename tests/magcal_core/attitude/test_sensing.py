import numpy as np
import pytest

from magcal_core.attitude.sensing import Gyro, Magnetometer
from magcal_core.errors import InputError


def test_each_term_of_the_sensor_model_stands_where_the_paper_has_it(table_1):
    """A = M_eps M_mounting B (1 + alpha) + 0, then h = T A + b, read off with a field along each axis."""
    b = np.array([20_000.0, -5_000.0, 30_000.0])
    m = Magnetometer(eps_rad=(0.01, 0.02, 0.03), common_scale=0.005, bias_nt=(1.0, 2.0, 3.0), sensor=table_1)
    skewed = 1.005 * np.array([b[0], b[1] + 0.01 * b[0], b[2] + 0.02 * b[0] + 0.03 * b[1]])
    np.testing.assert_allclose(m.matrix @ b + m.offset_nt, table_1.apply(skewed) + np.array([1.0, 2.0, 3.0]), atol=1e-9)


def test_correction_with_the_sensors_own_parameters_gives_the_field_back(table_1):
    m = Magnetometer(sensor=table_1, corrected_with=table_1)
    np.testing.assert_allclose(m.matrix, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(m.offset_nt, 0.0, atol=1e-12)


def test_mounting_turns_the_field(table_1):
    m = Magnetometer(mounting_rad=(0.1, 0.0, 0.0))
    np.testing.assert_allclose(m.matrix @ [1.0, 0.0, 0.0], [np.cos(0.1), 0.0, np.sin(0.1)], atol=1e-15)


def test_noise_passes_through_the_correction(table_1):
    """Standard deviations of 40,000 draws are good to 0.4 %; 2 % is five sigma."""
    drawn = Magnetometer(noise_nt=100.0, corrected_with=table_1).noise(np.random.default_rng(3), 40_000)
    want = 100.0 * np.linalg.norm(table_1.correction_matrix, axis=1)
    np.testing.assert_allclose(drawn.std(axis=0), want, rtol=0.02)


def test_gyro_error_is_bias_and_noise():
    drawn = Gyro((1e-5, 0.0, -1e-5), 1e-4).error(np.random.default_rng(4), 40_000)
    np.testing.assert_allclose(drawn.mean(axis=0), [1e-5, 0.0, -1e-5], atol=3e-6)
    np.testing.assert_allclose(drawn.std(axis=0), 1e-4, rtol=0.02)


@pytest.mark.parametrize("wrong", [{"noise_nt": -1.0}, {"bias_nt": (np.nan, 0.0, 0.0)}, {"common_scale": -1.0}])
def test_a_magnetometer_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError):
        Magnetometer(**wrong)


def test_negative_gyro_noise_is_refused():
    with pytest.raises(InputError):
        Gyro(noise_rad_s=-1.0)
