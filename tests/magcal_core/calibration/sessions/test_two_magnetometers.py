"""Two sensors made from one field: what was put between them must come out, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix, from_rotation_vector
from magcal_core.calibration.sessions.two_magnetometers import CorrectedReadings, compare_magnetometers
from magcal_core.errors import TooFewSamplesError
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Simulation, simulate

IDEAL = SensorModel(np.zeros(3), np.ones(3), np.zeros(3))
START = np.datetime64("2022-02-19T22:37:44")


@pytest.fixture(scope="module")
def mission(data_dir: Path) -> Simulation:
    orbit = Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))
    return simulate(orbit, IDEAL, START, 7000.0, 10.0, seed=3)


def reading(mission: Simulation, seed: int, matrix: np.ndarray, offset: list[float]) -> CorrectedReadings:
    random = np.random.default_rng(seed)
    b = mission.b_base_nt @ matrix.T + offset + 60.0 * random.normal(size=mission.b_base_nt.shape)
    return CorrectedReadings(mission.samples.t_utc, b)


def test_rotation_offset_and_gain_between_two_sensors_are_found(mission) -> None:
    """Every figure within 4.5 of its errors of the truth, over 15 figures."""
    turn = attitude_matrix(from_rotation_vector(np.deg2rad([-1.0, 2.0, 0.5])[None]))[0]
    gain = np.array([[2e-3, 1e-3, 0.0], [1e-3, -3e-3, 5e-4], [0.0, 5e-4, 1e-3]])
    second = reading(mission, 1, np.eye(3), [0.0, 0.0, 0.0])
    first = reading(mission, 2, (np.eye(3) + gain) @ turn, [120.0, -40.0, 15.0])
    first.b_nt[::50] += 8000.0
    found = compare_magnetometers(first, second, distance_m=0.5)
    assert np.all(np.abs(found.offset_nt - [120.0, -40.0, 15.0]) < 4.5 * found.offset_errors_nt)
    assert np.all(np.abs(found.gain - gain) < 4.5 * found.gain_errors)
    # exp(-[v x]) is what the attitude matrix of v is.
    assert np.all(np.abs(found.rotation_vector_deg - [1.0, -2.0, -0.5]) < 4.5 * found.rotation_errors_deg)
    np.testing.assert_allclose(found.gradient_nt_per_m, found.offset_nt / 0.5)
    assert {text.split(":")[0] for text in found.findings} == {"rotated", "offset", "gain"}
    assert found.before.mean_deg == pytest.approx(np.linalg.norm([1.0, 2.0, 0.5]), rel=0.35)
    assert found.after.rms_deg < 0.35  # 60 nT a component and sensor over 24 to 46 uT
    assert found.rms_after_nt == pytest.approx(60.0 * np.sqrt(2.0), rel=0.1)
    assert found.to_dict()["pairs"] == 700


def test_two_equal_sensors_show_no_difference(mission) -> None:
    found = compare_magnetometers(reading(mission, 5, np.eye(3), [0.0] * 3), reading(mission, 6, np.eye(3), [0.0] * 3))
    assert found.findings == ()


def test_a_left_handed_sensor_is_named(mission) -> None:
    mirror = np.diag([1.0, -1.0, 1.0])
    found = compare_magnetometers(reading(mission, 5, mirror, [0.0] * 3), reading(mission, 6, np.eye(3), [0.0] * 3))
    assert found.findings[0].startswith("left_handed")
    np.testing.assert_allclose(found.rotation, mirror, atol=1e-2)


def test_sensors_read_at_other_times_are_brought_together(data_dir: Path) -> None:
    """4 s apart at 0.76 deg/s and 10 s: interpolation errs by some nT, the noise-free sensors agree to 0.02 deg."""
    orbit = Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))
    whole = simulate(orbit, IDEAL, START, 6000.0, 1.0, seed=4)
    first = CorrectedReadings(whole.samples.t_utc[4::10], whole.b_base_nt[4::10])
    second = CorrectedReadings(whole.samples.t_utc[::10], whole.b_base_nt[::10])
    found = compare_magnetometers(first, second)
    assert found.pairs >= 590
    assert np.linalg.norm(found.rotation_vector_deg) < 0.02
    assert found.after.rms_deg < 0.1


def test_too_few_pairs_are_refused(mission) -> None:
    one = reading(mission, 1, np.eye(3), [0.0] * 3)
    later = CorrectedReadings(one.t_utc + np.timedelta64(3, "h"), one.b_nt)
    with pytest.raises(TooFewSamplesError):
        compare_magnetometers(one, later)
