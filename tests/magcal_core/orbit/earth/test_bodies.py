"""Sun and Moon: DE421 against SOFA's series, and positions against their own velocities."""

import numpy as np
import pytest

from magcal_core.errors import ModelRangeError, OptionError
from magcal_core.orbit.earth.bodies import default_ephemeris, sun_moon_gcrf

T_UTC = np.datetime64("2022-02-19T22:37:44.130", "ns") + np.arange(0, 30, 3).astype("timedelta64[D]")


def test_de421_and_sofa_agree_within_the_series_accuracy() -> None:
    """epv00 is 0.45 km and moon98 4.4 km from DE421 at this date; 12 km and 15 km bound a month."""
    ours_km, ours_km_s = sun_moon_gcrf(T_UTC, "de421")
    sofa_km, sofa_km_s = sun_moon_gcrf(T_UTC, "erfa")
    apart_km = np.linalg.norm(ours_km - sofa_km, axis=2).max(axis=0)
    assert apart_km[0] < 12.0
    assert apart_km[1] < 15.0
    np.testing.assert_allclose(ours_km_s, sofa_km_s, atol=1e-4)


@pytest.mark.parametrize("ephemeris", ["de421", "erfa"])
def test_velocity_is_the_derivative_of_position(ephemeris: str) -> None:
    """Central difference over two minutes; its truncation is 1e-7 km/s for the Moon."""
    minute = np.timedelta64(60, "s")
    after, _ = sun_moon_gcrf(T_UTC + minute, ephemeris)
    before, _ = sun_moon_gcrf(T_UTC - minute, ephemeris)
    _, velocity_km_s = sun_moon_gcrf(T_UTC, ephemeris)
    np.testing.assert_allclose((after - before) / 120.0, velocity_km_s, atol=3e-5 if ephemeris == "erfa" else 2e-6)


def test_distances_are_those_of_sun_and_moon() -> None:
    r_km, _ = sun_moon_gcrf(T_UTC)
    distance_km = np.linalg.norm(r_km, axis=2)
    assert np.all((distance_km[:, 0] > 1.47e8) & (distance_km[:, 0] < 1.53e8))
    assert np.all((distance_km[:, 1] > 3.56e5) & (distance_km[:, 1] < 4.07e5))


def test_dates_outside_de421_are_refused() -> None:
    with pytest.raises(ModelRangeError, match="DE421"):
        sun_moon_gcrf(np.array(["2210-01-01"], "datetime64[ns]"))


def test_an_unknown_ephemeris_is_refused() -> None:
    with pytest.raises(OptionError, match="de999"):
        sun_moon_gcrf(T_UTC, "de999")  # type: ignore[arg-type]


def test_de421_is_the_default_where_it_is_installed() -> None:
    assert default_ephemeris() == "de421"
