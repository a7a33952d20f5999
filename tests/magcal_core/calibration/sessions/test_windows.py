"""Long sessions in windows: each a calibration of its own, and a trend that follows a bias that drifts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.calibration.sessions.windows import windows_of
from magcal_core.errors import OptionError, TooFewSetsError
from tests.magcal_core.calibration.moving_bias import SENSOR, clean, session

HOURS = 16.0
DRIFT_NT_H = np.array([30.0, -20.0, 10.0])


@pytest.fixture(scope="module")
def drifting() -> mc.Samples:
    """Sixteen hours whose bias drifts by 480 nT."""
    plain = clean(600, HOURS)
    return session(600, np.arange(len(plain))[:, None] / 240.0 * DRIFT_NT_H, hours=HOURS)


def test_windows_follow_a_drift_that_one_calibration_does_not(drifting):
    found = mc.calibrate(drifting, method="vector", windows=2.0, bias_steps="none")
    record = found.to_dict()["windows"]
    assert (record["hours"], len(record["items"])) == (2.0, 8)
    ends = [(one["from"], one["until"]) for one in record["items"]]
    assert all(first[1] == second[0] for first, second in itertools.pairwise(ends))
    for i, one in enumerate(record["items"]):
        wanted = SENSOR.bias_nt + DRIFT_NT_H * (2.0 * i + 1.0)
        away = np.abs(np.array(one["parameters"]["bias_nt"]) - wanted)
        assert np.all(away < 4.5 * np.array(one["standard_errors"]["bias_nt"]) + 20.0)
    at_end = SENSOR.bias_nt + DRIFT_NT_H * HOURS
    trend_nt = np.abs(np.array(record["trend"]["parameters"]["bias_nt"]) - at_end)
    assert trend_nt.max() < 0.5 * np.abs(found.parameters.bias_nt - at_end).max()
    assert record["trend"]["at"] == found.to_dict()["data_until"]


def test_auto_takes_twice_a_period_and_doubles_it_until_half_are_good(drifting):
    asked: list[int] = []

    def calibrate(part: mc.Samples) -> mc.Calibration:
        asked.append(len(part))
        if len(part) < 700:
            raise TooFewSetsError("too short for this test")
        return mc.calibrate(part, method="vector", bias_steps="none")

    found = windows_of(drifting, "auto", calibrate, period_s=3600.0)
    assert found.hours == 4.0
    assert (asked[0], asked[-1]) == (480, 959)
    assert windows_of(drifting, "auto", calibrate, period_s=7200.0).hours == 4.0


def test_fewer_than_three_windows_are_refused(drifting):
    for windows in (6.0, 12.0):
        with pytest.raises(OptionError, match="3 are needed"):
            mc.calibrate(drifting, method="vector", windows=windows)
    with pytest.raises(OptionError, match="3 are needed"):
        mc.calibrate(session(1, hours=3.0), method="vector", windows="auto")
    for bad in (0.0, -1.0, "soon", True):
        with pytest.raises(OptionError, match="windows"):
            mc.CalibrationOptions(windows=bad)


def test_windows_that_cannot_be_calibrated_say_why(drifting):
    with pytest.raises(TooFewSetsError, match="4 usable samples"):
        windows_of(drifting.take(slice(None, None, 120)), 2.0, lambda part: mc.calibrate(part, method="scalar"))
