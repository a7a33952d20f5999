"""Which orbit a sample uses, and when it is too old."""

from dataclasses import dataclass

import numpy as np
import pytest

from magcal_core.errors import OrbitMissingError, TleEpochError
from magcal_core.orbit.choose import NO_ORBIT, check_age, choose_orbits


@dataclass
class Elements:
    """An orbit with an epoch; where it is does not matter here."""

    epoch_utc: np.datetime64
    model: str = "sgp4"

    def position_itrf_km(self, t_utc: np.ndarray) -> np.ndarray:
        raise AssertionError("an orbit is chosen by its epoch, not by where it is")

    def state_gcrf(self, t_utc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise AssertionError("an orbit is chosen by its epoch, not by where it is")


@dataclass
class Ephemeris(Elements):
    """An orbit that is known for two hours from its epoch."""

    model: str = "oem"

    def covers(self, t_utc: np.ndarray) -> np.ndarray:
        return (t_utc >= self.epoch_utc) & (t_utc <= self.epoch_utc + np.timedelta64(2, "h"))


def _day(day: float) -> np.datetime64:
    return np.datetime64("2022-02-01", "ns") + np.timedelta64(round(day * 86400e9), "ns")


def _days(*days: float) -> np.ndarray:
    return np.array([_day(day) for day in days])


def test_each_sample_uses_the_nearest_epoch_in_whatever_order_they_come() -> None:
    orbits = [Elements(_day(4)), Elements(_day(0)), Elements(_day(1)), Elements(_day(9))]
    times = _days(-1, 0.2, 0.6, 2.4, 2.6, 6.4, 6.6, 20)
    choice = choose_orbits(orbits, times)
    distance = np.abs(times[:, None] - np.array([orbit.epoch_utc for orbit in orbits])[None])
    np.testing.assert_array_equal(choice.index, np.argmin(distance, axis=1))
    np.testing.assert_allclose(choice.age_days, distance.min(axis=1) / np.timedelta64(1, "D"), rtol=1e-12)


def test_an_ephemeris_is_used_where_it_covers_and_nowhere_else() -> None:
    orbits = [Elements(_day(0)), Ephemeris(_day(1))]
    choice = choose_orbits(orbits, _days(0.99, 1.0, 1.05, 1.1))
    np.testing.assert_array_equal(choice.index, [0, 1, 1, 0])
    np.testing.assert_array_equal(choice.age_days[1:3], 0.0)


def test_without_other_orbits_the_edges_of_an_ephemeris_are_refused() -> None:
    choice = choose_orbits([Ephemeris(_day(1))], _days(0.99, 1.01))
    np.testing.assert_array_equal(choice.index, [NO_ORBIT, 0])
    assert np.isnan(choice.age_days[0])


def test_no_orbits_are_an_error() -> None:
    with pytest.raises(OrbitMissingError):
        choose_orbits([], _days(0))


@pytest.mark.parametrize(
    ("age_days", "limit_days", "warns"), [(3.0, 14, 0), (3.1, 14, 1), (14.0, 14, 1), (33.3, 60, 1)]
)
def test_an_old_tle_is_used_with_a_warning(age_days: float, limit_days: float, warns: int) -> None:
    orbits = [Elements(_day(0))]
    warnings = check_age(choose_orbits(orbits, _days(0, age_days)), orbits, limit_days)
    assert len(warnings) == warns
    assert all(
        warning.startswith(f"tle_old: the epoch of the TLE, 2022-02-01T00:00:00Z, is {age_days}")
        for warning in warnings
    )


def test_a_tle_past_the_limit_is_refused_on_either_side_of_its_epoch() -> None:
    orbits = [Elements(_day(0))]
    for age_days in (14.1, -14.1):
        with pytest.raises(TleEpochError, match=r"14\.1 d from the telemetry; limit 14\.0 d"):
            check_age(choose_orbits(orbits, _days(0, age_days)), orbits)


def test_age_is_no_matter_inside_an_ephemeris() -> None:
    orbits = [Ephemeris(_day(1))]
    assert check_age(choose_orbits(orbits, _days(0.0, 1.01)), orbits) == []
