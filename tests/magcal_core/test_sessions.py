"""The same results as their parts give, from telemetry, orbits and records as they come."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix, from_rotation_vector
from magcal_core.calibration.sessions.monitoring import ActiveSet
from magcal_core.errors import OptionError
from magcal_core.observations import Observations, corrected_nt
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
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


DRIFT_NT_PER_H = (300.0, 0.0, -200.0)


def drifting(orbit, hours: float, seed: int, moved: float = 0.0):
    bias_nt = SENSOR.bias_nt + hours * np.array(DRIFT_NT_PER_H) + np.array([moved, 0.0, 0.0])
    return sent(orbit, replace(SENSOR, bias_nt=bias_nt), seed, hours, drift_nt_per_h=DRIFT_NT_PER_H).samples


@pytest.fixture(scope="module")
def drifted(orbit):
    return calibrate(drifting(orbit, 0.0, 1), [orbit], regressors=("time",))


class TestTimeBase:
    """A sensor whose bias drifts: a set with the regressor ``time``, and what comes hours later."""

    def test_the_record_says_since_when_it_counts(self, orbit, drifted) -> None:
        record = drifted.to_dict()
        assert record["parameters"]["time_base_utc"] == record["data_from"]
        assert Parameters.from_record(record).time_base_utc == drifted.residuals.t_utc[0]
        assert "time_base_utc" not in calibrate(drifting(orbit, 0.0, 1), [orbit]).to_dict()["parameters"]

    @pytest.mark.parametrize("hours", [6.0, -6.0])
    def test_the_same_drift_hours_later_agrees(self, orbit, drifted, hours) -> None:
        judged = monitor(drifting(orbit, hours, 2), [orbit], drifted.to_dict())
        assert judged.grade == "agrees", judged.reasons
        assert judged.residual_ratio < 1.5

    def test_a_step_hours_later_is_seen_beside_the_drift(self, orbit, drifted) -> None:
        judged = monitor(drifting(orbit, 6.0, 3, moved=9000.0), [orbit], drifted.to_dict())
        assert judged.grade == "disagrees"

    def test_sets_hours_apart_are_compared_at_one_time(self, orbit, drifted) -> None:
        active = ActiveSet.from_record(drifted.to_dict())
        again = calibrate(drifting(orbit, 6.0, 4), [orbit], regressors=("time",), active=active)
        assert again.parameters.bias_nt[0] - drifted.parameters.bias_nt[0] == pytest.approx(1800.0, abs=300.0)
        assert not again.extras["agreement"]["differs"]
        assert again.extras["agreement"]["p_value"] > 1e-3

    def test_a_set_that_does_not_say_since_when_is_refused(self, orbit, drifted) -> None:
        record = drifted.to_dict()
        older = {**record, "parameters": {k: v for k, v in record["parameters"].items() if k != "time_base_utc"}}
        with pytest.raises(OptionError, match="since when"):
            monitor(drifting(orbit, 6.0, 2), [orbit], older)

    def test_joint_sessions_have_one_time_base(self, orbit) -> None:
        sessions = {"first": drifting(orbit, 0.0, 1), "second": drifting(orbit, 4.0, 2)}
        joint = calibrate_jointly(sessions, [orbit], CalibrationOptions(regressors=("time",)))
        assert joint.consistency is not None
        assert joint.consistency.is_consistent, joint.consistency.text
        first, second = (one.parameters for one in joint.sessions)
        assert first.time_base_utc == second.time_base_utc == sessions["first"].t_utc[0]
        errors = np.hypot(*(one.standard_errors.bias_nt for one in joint.sessions))
        assert np.all(np.abs(first.bias_nt - second.bias_nt) < 4.5 * errors)

    def test_corrected_sensors_follow_the_time_base(self, orbit, drifted) -> None:
        """The same readings, corrected by a set and by itself counted since another instant: no difference at all."""
        samples = drifting(orbit, 6.0, 5)
        moved = drifted.parameters.at_time_base(samples.t_utc[0])
        compared = compare_sensors((samples, drifted.parameters), (samples, moved))
        np.testing.assert_allclose(compared.offset_nt, 0.0, atol=1e-6)
        assert compared.rms_after_nt < 1e-6


def test_parameters_at_another_time_base_correct_alike() -> None:
    """Drifts of bias and scale, exactly: h (1 - c t) - d t in both countings, to rounding."""
    rng = np.random.default_rng(3)
    slopes = {"time": np.array([30.0, -20.0, 5.0]), "amps": np.array([100.0, 0.0, 3.0])}
    slopes |= {"time*h": np.array([1e-3, -2e-3, 3e-3]), "amps*h": np.array([1e-4, 2e-4, 0.0])}
    base, other = np.datetime64("2022-03-01T00:00:00", "ns"), np.datetime64("2022-03-01T07:30:00", "ns")
    first = Parameters(SENSOR.bias_nt, SENSOR.scale, SENSOR.nonorthogonality_deg, None, slopes, base)
    second = first.at_time_base(other)
    h_nt, hours, amps = 3e4 * rng.normal(size=(50, 3)), rng.uniform(0.0, 12.0, 50), rng.normal(size=50)
    corrected = []
    for parameters, t in ((first, hours), (second, hours - 7.5)):
        columns = {"time": t, "amps": amps, "time*h": t[:, None] * h_nt, "amps*h": amps[:, None] * h_nt}
        observed = Observations(t, h_nt, np.ones(50), None, np.ones(50), columns)
        corrected.append(corrected_nt(observed, parameters))
    np.testing.assert_allclose(corrected[0], corrected[1], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(second.at_time_base(base).vector, first.vector, rtol=1e-12)
