"""A wrong unit beside a bias that is only large."""

import numpy as np
import pytest

from magcal_core.calibration.diagnosis.rows_and_axes import wrong_unit
from magcal_core.numerics.sphere import even_directions
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel


@pytest.fixture
def far_nt():
    """Field of a far orbit in all directions, nT: 2 to 40 uT, most of it weak."""
    size = 2000.0 * 20.0 ** (np.linspace(0.0, 1.0, 400) ** 2)
    return even_directions(400)[np.random.default_rng(5).permutation(400)] * size[:, None]


def test_a_bias_beside_a_weak_field_is_no_unit(far_nt):
    """50 uT are fourteen times the field in the median, and less than five times it near the perigee."""
    size = np.linalg.norm(far_nt, axis=1)
    reading = far_nt + np.array([40000.0, 30000.0, 0.0])
    assert np.median(np.linalg.norm(reading, axis=1) / size) > 8.0
    assert wrong_unit(reading, size) is None


def test_a_transfer_orbit_with_a_large_bias_is_calibrated():
    """Readings are 9 times the field in the median (refused as of a wrong unit before), most of them bias."""
    truth = SensorModel(np.array([60000.0, 40000.0, -30000.0]), np.ones(3), np.zeros(3))
    b_nt = even_directions(600)[np.random.default_rng(6).permutation(600)]
    b_nt = b_nt * (2000.0 * 20.0 ** (np.linspace(0.0, 1.0, 600) ** 2))[:, None]
    h_nt = truth.apply(b_nt) + 20.0 * np.random.default_rng(7).normal(size=b_nt.shape)
    t_utc = np.datetime64("2022-02-19", "ns") + np.arange(600) * np.timedelta64(10, "s")
    found = calibrate(Samples(t_utc, h_nt, b_ref_magnitude_nt=np.linalg.norm(b_nt, axis=1)))
    np.testing.assert_allclose(found.parameters.bias_nt, truth.bias_nt, atol=30.0)
    assert found.verdict.grade == "accept"


@pytest.mark.parametrize(("factor", "named"), [(100.0, "100 times"), (0.001, "0.001 times")])
def test_a_unit_shows_beside_a_strong_field_too(far_nt, factor, named):
    """To 2 % of the ratio, which is the factor."""
    found = wrong_unit(factor * far_nt, np.linalg.norm(far_nt, axis=1))
    assert found is not None
    assert found.code == "unit"
    assert found.value == pytest.approx(factor, rel=0.02)
    assert named in found.text
