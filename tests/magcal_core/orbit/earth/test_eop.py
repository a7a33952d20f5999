"""UT1, polar motion and Julian dates against erfa and astropy."""

from datetime import date, timedelta

import erfa
import numpy as np
import pytest
from astropy.time import Time
from astropy.utils import iers

from magcal_core.errors import ModelRangeError, TimeError
from magcal_core.orbit.earth.eop import earth_orientation
from magcal_core.orbit.earth.timescales import julian_tt, julian_utc, nanoseconds, tai_minus_utc_s


def test_tai_minus_utc_is_erfas_on_both_sides_of_every_leap_second() -> None:
    starts = [date(row["year"], row["month"], 1) for row in erfa.leap_seconds.get() if row["year"] > 1972]
    for days in (starts, [day - timedelta(days=1) for day in starts]):
        want = [erfa.dat(day.year, day.month, day.day, 0.0) for day in days]
        np.testing.assert_array_equal(tai_minus_utc_s(np.array(days, "datetime64[ns]")), want)


def test_julian_dates_agree_with_erfa_to_a_nanosecond() -> None:
    t_utc = np.array(["2022-02-19T22:37:44.130", "1973-01-02", "2026-07-01T23:59:59.999999999"], "datetime64[ns]")
    calendar = [(2022, 2, 19, 22, 37, 44.13), (1973, 1, 2, 0, 0, 0.0), (2026, 7, 1, 23, 59, 59.999999999)]
    for i, stamp in enumerate(calendar):
        utc = erfa.dtf2d("UTC", *stamp)
        np.testing.assert_allclose(sum(np.subtract([j[i] for j in julian_utc(t_utc)], utc)), 0, atol=1e-14)
        tt = erfa.taitt(*erfa.utctai(*utc))
        np.testing.assert_allclose(sum(np.subtract([j[i] for j in julian_tt(t_utc)], tt)), 0, atol=1e-14)


def test_orientation_agrees_with_astropys_table(offline_astropy: None) -> None:
    """Linear interpolation of the same table; 1 ns of UT1 is 0.5 um, 1e-12 rad of the pole 6 um."""
    t_utc = np.datetime64("1990-01-01T05:00", "ns") + np.arange(300).astype("timedelta64[m]") * (45 * 1440 + 61)
    table = iers.earth_orientation_table.get()
    times = Time(t_utc, scale="utc")
    x, y = table.pm_xy(times)
    x_rad, y_rad = earth_orientation().polar_motion_rad(t_utc)
    np.testing.assert_allclose(
        earth_orientation().ut1_minus_utc_s(t_utc), table.ut1_utc(times).to_value("s"), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(x_rad, x.to_value("rad"), rtol=0, atol=1e-12)
    np.testing.assert_allclose(y_rad, y.to_value("rad"), rtol=0, atol=1e-12)


def test_ut1_is_continuous_across_a_leap_second() -> None:
    """2016-12-31T23:59:60 was inserted: UT1 - UTC jumps by a second, UT1 by the 2 s of SI time between the labels."""
    t_utc = np.array(["2016-12-31T23:59:59", "2017-01-01T00:00:00"], "datetime64[ns]")
    before_s, after_s = earth_orientation().ut1_minus_utc_s(t_utc)
    assert after_s - before_s == pytest.approx(1.0, abs=1e-6)


def test_day_and_fraction_reach_the_last_day_of_the_table() -> None:
    table = earth_orientation()
    ends = np.array([table.first, table.last])
    assert np.isfinite(table.ut1_minus_utc_s(ends)).all()
    assert table.first < table.predicted_from < table.last


@pytest.mark.parametrize("when", ["1973-01-01T23:59:59", "2099-01-01"])
def test_times_outside_the_table_are_refused_with_its_limits(when: str) -> None:
    with pytest.raises(ModelRangeError, match=r"1973-01-02 to 20\d\d-\d\d-\d\d"):
        earth_orientation().ut1_minus_utc_s(np.array([when], "datetime64[ns]"))


def test_what_is_not_a_time_is_refused() -> None:
    with pytest.raises(TimeError, match=r"time 1 .*NaT"):
        nanoseconds(np.array(["2022-01-01", "NaT"], "datetime64[ns]"))
    with pytest.raises(TimeError, match="datetime64"):
        nanoseconds(np.array([1.0]))
    with pytest.raises(TimeError, match=r"\(n,\)"):
        nanoseconds(np.zeros((2, 2), "datetime64[ns]"))
    with pytest.raises(TimeError, match="1972"):
        tai_minus_utc_s(np.array(["1971-12-31"], "datetime64[ns]"))


def test_coarser_units_of_time_are_the_same_instants() -> None:
    np.testing.assert_array_equal(
        nanoseconds(np.array(["2022-02-19T22:37"], "datetime64[m]")),
        nanoseconds(np.array(["2022-02-19T22:37:00"], "datetime64[ns]")),
    )
