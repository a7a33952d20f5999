"""A parameter set whose matrix is full: applied, taken back, and exported with a worked reading that holds."""

import numpy as np
import pytest

from app.parameter_sets.correction import Correction
from app.parameter_sets.worked_example import FULL, formula, worked
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel, lower_triangular_gauge, parameters_of_matrix

MATRIX = np.array([[1.19, -0.13, 0.17], [-0.05, 1.01, 0.23], [0.17, -0.03, 1.07]])
BIAS_NT = np.array([900.0, 4600.0, -250.0])
FIELD_NT = np.array([[21000.0, -14000.0, 33000.0], [-8000.0, 30000.0, 12000.0]])


@pytest.fixture
def record():
    lower = lower_triangular_gauge(MATRIX)[0]
    scale, angles_rad = parameters_of_matrix(lower)
    parameters = {
        "bias_nt": BIAS_NT.tolist(),
        "scale": scale.tolist(),
        "nonorthogonality_deg": np.rad2deg(angles_rad).tolist(),
        "regressors": {},
    }
    return {"parameters": parameters, "matrix": MATRIX.tolist()}


def readings():
    times = np.datetime64("2024-01-01", "ns") + np.arange(2) * np.timedelta64(1, "s")
    return Samples(times, FIELD_NT @ MATRIX.T + BIAS_NT)


def test_raw_readings_become_the_field_in_the_base_frame_and_back(record):
    correction = Correction.of(record)
    corrected = correction.apply(readings())
    np.testing.assert_allclose(corrected.h_nt, FIELD_NT, atol=1e-8)
    np.testing.assert_allclose(correction.unapply(corrected).h_nt, readings().h_nt, atol=1e-8)


def test_a_lower_triangular_matrix_is_not_turned(record):
    lower = lower_triangular_gauge(MATRIX)[0]
    corrected = Correction.of(record | {"matrix": lower.tolist()}).apply(readings())
    np.testing.assert_allclose(corrected.h_nt, FIELD_NT @ lower_triangular_gauge(MATRIX)[1].T, atol=1e-8)


@pytest.mark.parametrize("convention", ["exact", "lower-triangular", "on-board"])
def test_the_exported_formula_is_that_of_the_full_matrix(record, convention):
    correction = Correction.of(record)
    got = worked(correction.sensor, {}, correction.rotation)
    inverse = np.linalg.inv(MATRIX)
    np.testing.assert_allclose(inverse @ (np.array(got.raw_nt) - BIAS_NT), got.corrected_nt, atol=1e-6)
    assert isinstance(correction.sensor, SensorModel)
    assert formula(convention, [], is_full=True).startswith(FULL)
    assert not formula(convention, []).startswith(FULL)
