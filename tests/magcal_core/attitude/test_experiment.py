"""What a calibration buys: the figures of `docs/attitude.md` for DEKART's magnetometer, to 5 %."""

import json

import numpy as np
import pytest

from magcal_core.attitude.experiment import calibration_impact, pointing_impact
from magcal_core.attitude.scenario import Gains
from magcal_core.errors import InputError
from magcal_core.field.models import field_model
from magcal_core.sensor.model import SensorModel

IGRF = field_model("igrf-13")
RESIDUAL = SensorModel([20.0, -20.0, 20.0], [1.001, 0.999, 1.0], [0.05, -0.05, 0.05])
"""A sensor corrected to 0.1 % of scale between the axes, 3 arcmin and 20 nT."""
PERFECT = SensorModel([0.0] * 3, [1.0] * 3, [0.0] * 3)


def errors(impact, name):
    return [getattr(orbit, name).max_error_deg for orbit in impact.orbits]


def rates(impact, name):
    return [getattr(orbit, name).max_rate_error_deg_s for orbit in impact.orbits]


def test_raw_and_calibrated_dekart_point_as_known(table_1, table_2):
    impact = pointing_impact(table_1, table_2, active=table_1, field=IGRF)
    np.testing.assert_allclose(errors(impact, "raw"), [24.4, 31.8], rtol=0.05)
    np.testing.assert_allclose(rates(impact, "raw"), [0.034, 0.043], rtol=0.05)
    np.testing.assert_allclose(errors(impact, "calibrated"), [2.7, 4.2], rtol=0.05)
    np.testing.assert_allclose(rates(impact, "calibrated"), [0.0034, 0.0045], rtol=0.05)
    np.testing.assert_allclose(errors(impact, "ideal"), 0.17, rtol=0.05)
    np.testing.assert_allclose(errors(impact, "active"), errors(impact, "ideal"), rtol=1e-6)


def test_a_shorter_tau_points_worse(table_1, table_2):
    impact = pointing_impact(table_1, table_2, field=IGRF, gains=Gains(0.05, 5.0))
    np.testing.assert_allclose(errors(impact, "ideal"), [0.89, 0.87], rtol=0.05)
    np.testing.assert_allclose(errors(impact, "raw"), [36.7, 46.2], rtol=0.05)
    np.testing.assert_allclose(errors(impact, "calibrated"), [3.8, 4.0], rtol=0.05)


def test_a_good_calibration_brings_the_error_to_half_a_degree():
    impact = pointing_impact(RESIDUAL, PERFECT, field=IGRF)
    np.testing.assert_allclose(errors(impact, "calibrated"), [0.41, 0.52], rtol=0.05)
    impact = pointing_impact(RESIDUAL, PERFECT, field=IGRF, gains=Gains(0.05, 5.0))
    np.testing.assert_allclose(errors(impact, "calibrated"), 1.4, rtol=0.05)


def test_a_calibration_is_as_good_as_its_covariance_says(table_1, table_2):
    """With the residual's size as one sigma the worst of 16 draws lies between the ideal and a degree and a half."""
    sigma = np.array([20.0] * 3 + [0.001] * 3 + [0.05] * 3)
    impact = calibration_impact(table_1, np.diag(sigma**2), active=table_2)
    for orbit in impact.orbits:
        assert 0.2 < orbit.calibrated.max_error_deg < 1.5
        assert orbit.calibrated.max_error_deg < orbit.active.max_error_deg < orbit.raw.max_error_deg


def test_an_exact_calibration_leaves_the_ideal(table_1):
    impact = calibration_impact(table_1, np.zeros((9, 9)), draws=1)
    np.testing.assert_allclose(errors(impact, "calibrated"), errors(impact, "ideal"), rtol=1e-6)


def test_the_answer_is_plain_json(table_1, table_2):
    record = calibration_impact(table_1, np.zeros((9, 9)), active=table_2).to_dict()
    assert json.loads(json.dumps(record)) == record
    assert record["field_model"] == "igrf-14"


@pytest.mark.parametrize("covariance", [np.zeros((3, 3)), np.full((9, 9), np.nan)])
def test_a_covariance_that_cannot_be_drawn_from_is_refused(table_1, covariance):
    with pytest.raises(InputError, match="covariance"):
        calibration_impact(table_1, covariance)
