"""Mountings that were put in must come out, with errors that hold; what is free must be said to be free."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix, from_rotation_vector
from magcal_core.calibration.diagnosis.mounting import mounting_by_second, mounting_of, rotation_vector, sensor_of
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.scalar import ScalarFit
from magcal_core.errors import OptionError
from magcal_core.observations import Observations
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.telemetry import Disturbances, simulate

SENSOR = SensorModel(np.array([2900.0, -1200.0, -1900.0]), np.array([1.03, 1.01, 1.04]), np.array([-4.0, -1.5, 7.0]))

NO_REGRESSORS = Parameters(SENSOR.bias_nt, SENSOR.scale, SENSOR.nonorthogonality_deg)


@pytest.fixture(scope="module")
def observed(data_dir: Path) -> Observations:
    orbit = Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))
    disturbed = Disturbances(noise_nt=80.0, outlier_fraction=0.02)
    made = simulate(orbit, SENSOR, np.datetime64("2022-02-19T22:37:44"), 8000.0, 10.0, disturbances=disturbed, seed=1)
    return Observations.of(made.samples_with_reference)


def turned(observed: Observations, rotation: np.ndarray) -> Observations:
    """Return the same readings with the reference in a frame from which ``rotation`` leads to the base frame."""
    assert observed.b_base_nt is not None
    return replace(observed, b_base_nt=np.ascontiguousarray(observed.b_base_nt @ rotation))


def rotation_of(vector_deg: list[float]) -> np.ndarray:
    """Return exp([v x]): attitude matrices are passive, hence the sign."""
    return attitude_matrix(from_rotation_vector(-np.deg2rad(np.array(vector_deg))[None]))[0]


@pytest.mark.parametrize("vector_deg", [[0.5, -0.3, 0.2], [20.0, 70.0, -120.0], [0.0, 180.0, 0.0]])
def test_a_rotation_that_the_scalar_fit_leaves_free_is_resolved_by_attitude(observed, vector_deg) -> None:
    """Each component within 4.5 honest standard errors of what was put in."""
    rotation = rotation_of(vector_deg)
    scalar = ScalarFit().fit(observed, FitSettings(robust="huber"))
    found = mounting_of(turned(observed, rotation), scalar.parameters)
    assert (found.state, found.by) == ("resolved", "attitude")
    left = rotation_vector(found.rotation @ rotation.T)
    assert np.all(np.abs(np.rad2deg(left)) < 4.5 * found.standard_errors_deg)
    assert found.standard_errors_deg.max() < 0.1
    assert found.inverted_axes == ()
    sensor = sensor_of(found)
    assert sensor is not None
    np.testing.assert_allclose(sensor.scale, SENSOR.scale, atol=2e-3)
    np.testing.assert_allclose(sensor.nonorthogonality_deg, SENSOR.nonorthogonality_deg, atol=0.15)


def test_the_rotations_errors_are_its_scatter(data_dir: Path) -> None:
    """40 seeds: mean square of z between 0.6 and 1.8 (120 values; honest errors are never below formal ones)."""
    orbit = Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))
    rotation, z = rotation_of([1.0, 2.0, -3.0]), []
    for seed in range(40):
        made = simulate(
            orbit,
            SENSOR,
            np.datetime64("2022-02-19T22:37:44"),
            3000.0,
            10.0,
            disturbances=Disturbances(100.0),
            seed=seed,
        )
        found = mounting_of(turned(Observations.of(made.samples_with_reference), rotation), NO_REGRESSORS)
        z.append(np.rad2deg(rotation_vector(found.rotation @ rotation.T)) / found.standard_errors_deg)
    assert 0.6 < np.mean(np.square(z)) < 1.8


def test_the_lower_triangular_hypothesis_holds_in_the_base_frame_and_falls_outside(observed) -> None:
    right = mounting_of(observed, NO_REGRESSORS)
    assert right.is_lower_triangular
    assert right.angle_deg < 0.1
    wrong = mounting_of(turned(observed, rotation_of([0.4, 0.0, 0.0])), NO_REGRESSORS)
    assert wrong.is_lower_triangular is False
    assert "does not hold" in wrong.text


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_inverted_axis_is_named_where_the_direction_is_known(observed, axis: int) -> None:
    flipped = observed.h_nt.copy()
    flipped[:, axis] *= -1.0
    found = mounting_of(replace(observed, h_nt=flipped), NO_REGRESSORS)
    assert found.inverted_axes == (axis + 1,)
    assert "left-handed" in found.text
    assert np.linalg.det(found.rotation) < 0


def test_without_attitude_the_rotation_is_said_to_be_free(observed) -> None:
    found = mounting_of(replace(observed, b_base_nt=None), NO_REGRESSORS)
    assert found.state == "free"
    assert "inverted" in found.text
    assert found.rotation is None
    assert found.is_lower_triangular is None
    record = found.to_dict()
    assert record["state"] == "free"
    assert record["rotation"] is None


def test_a_field_in_a_plane_resolves_nothing(observed) -> None:
    flat = observed.b_base_nt * [1.0, 1.0, 0.0]
    assert mounting_of(replace(observed, b_base_nt=flat), NO_REGRESSORS).state == "free"


def test_a_second_magnetometer_hands_its_mounting_on(observed) -> None:
    second = mounting_of(turned(observed, rotation_of([3.0, 0.0, 0.0])), NO_REGRESSORS)
    between = rotation_of([0.0, 5.0, 0.0])
    found = mounting_by_second(between, np.eye(3) * 1e-8, second)
    np.testing.assert_allclose(found.rotation, between @ second.rotation)
    assert found.by == "second-magnetometer"
    assert found.is_lower_triangular is None
    with pytest.raises(OptionError):
        mounting_by_second(between, np.eye(3), mounting_of(replace(observed, b_base_nt=None), NO_REGRESSORS))


@pytest.mark.parametrize("angle_deg", [1e-8, 1.0, 90.0, 179.9999, 180.0])
def test_rotation_vectors_survive_every_angle(angle_deg: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    found = np.rad2deg(rotation_vector(rotation_of(list(angle_deg * axis))))
    assert min(np.abs(found - s * angle_deg * axis).max() for s in ((1, -1) if angle_deg == 180.0 else (1,))) < 1e-5
