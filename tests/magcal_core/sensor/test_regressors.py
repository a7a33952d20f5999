"""The regressor of time: hours since its base, in a session and at one instant."""

import numpy as np

from magcal_core.sensor.regressors import TIME_REGRESSOR, hours_since, with_time

BASE = np.datetime64("2026-03-01T00:00:00", "ns")


def test_hours_count_from_the_base_forward():
    later = BASE + np.array([-30, 0, 90], dtype="timedelta64[m]")
    assert [hours_since(one, BASE) for one in later] == [-0.5, 0.0, 1.5]
    np.testing.assert_array_equal(with_time({}, later, BASE)[TIME_REGRESSOR], [-0.5, 0.0, 1.5])
    assert with_time({TIME_REGRESSOR: later}, later, BASE)[TIME_REGRESSOR] is later
    assert with_time({}, later, None) == {}
