"""The same results as their parts give, from telemetry, orbits and records as they come."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix, from_rotation_vector
from magcal_core.errors import OptionError
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel
from magcal_core.sessions import calibrate_jointly, compare_sensors, monitor
from magcal_core.simulation.telemetry import Disturbances, simulate

SENSOR = SensorModel(np.array([2900.0, -1200.0, -1900.0]), np.array([1.03, 1.01, 1.04]), np.array([-4.0, -1.5, 7.0]))
MOVED = replace(SENSOR, bias_nt=SENSOR.bias_nt + np.array([900.0, 0.0, -800.0]))


@pytest.fixture(scope="module")
def orbit(data_dir: Path) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))


def sent(orbit, sensor, seed: int, hours: float = 0.0, **more):
    start = np.datetime64("2022-02-19T22:37:44") + np.timedelta64(round(hours * 3600), "s")
    return simulate(orbit, sensor, start, 6000.0, 10.0, disturbances=Disturbances(noise_nt=80.0, **more), seed=seed)


def test_sessions_are_calibrated_jointly_from_telemetry_and_tle(orbit) -> None:
    sessions = {"first": sent(orbit, SENSOR, 1).samples, "second": sent(orbit, MOVED, 2, 5.0).samples}
    for method in ("scalar", "vector"):
        found = calibrate_jointly(sessions, [orbit], CalibrationOptions(method=method))
        for part, truth in zip(found.sessions, (SENSOR, MOVED), strict=True):
            assert np.all(np.abs(part.parameters.bias_nt - truth.bias_nt) < 4.5 * part.standard_errors.bias_nt)
        assert found.consistency is not None
        assert not found.consistency.is_consistent
    with pytest.raises(OptionError):
        calibrate_jointly(sessions, [orbit], CalibrationOptions(regressors="auto"))


def test_a_session_is_monitored_against_a_record(orbit) -> None:
    record = calibrate(sent(orbit, SENSOR, 1).samples, [orbit]).to_dict()
    assert monitor(sent(orbit, SENSOR, 2, 8.0).samples, [orbit], record).grade == "agrees"
    found = monitor(sent(orbit, MOVED, 3, 8.0).samples, [orbit], record)
    assert found.grade == "disagrees"
    assert found.to_dict()["grade"] == "disagrees"


def test_the_records_clock_is_taken_off(orbit) -> None:
    late = {"clock_offset_s": 12.0} if "clock_offset_s" in Disturbances.__slots__ else {"time_offset_s": 12.0}
    record = calibrate(sent(orbit, SENSOR, 1, **late).samples, [orbit], time_offset="estimate").to_dict()
    assert record["parameters"]["time_offset_s"] == pytest.approx(12.0, abs=1.0)
    assert monitor(sent(orbit, SENSOR, 2, 8.0, **late).samples, [orbit], record).grade == "agrees"
    assert monitor(sent(orbit, SENSOR, 2, 8.0).samples, [orbit], record).residual_ratio > 1.3


def test_two_sensors_are_compared_after_their_calibration(orbit) -> None:
    """The second sensor is turned by 2 deg: scalar calibrations leave that free, the comparison finds it."""
    first = sent(orbit, SENSOR, 1)
    turn = attitude_matrix(from_rotation_vector(np.deg2rad([0.0, -2.0, 0.0])[None]))[0]
    random = np.random.default_rng(5)
    readings = SENSOR.apply(first.b_base_nt @ turn.T) + 80.0 * random.normal(size=(600, 3))
    second = replace(first.samples, h_nt=readings)
    one, other = (calibrate(samples, [orbit]).parameters for samples in (first.samples, second))
    found = compare_sensors((first.samples, one), (second, other))
    assert np.linalg.norm(found.rotation_vector_deg) == pytest.approx(2.0, abs=0.3)
    assert any(text.startswith("rotated") for text in found.findings)
