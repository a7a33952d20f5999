"""Frames against astropy, erfa and the DEKART paper's state vectors."""

from itertools import product
from pathlib import Path

import erfa
import numpy as np
import pytest
from astropy import coordinates, units
from astropy.time import Time
from numpy.typing import NDArray
from sgp4.api import Satrec

from magcal_core.errors import FrameError
from magcal_core.orbit.earth import frames
from magcal_core.orbit.earth.eop import earth_orientation
from magcal_core.orbit.earth.timescales import julian_tt

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

DEKART_STATES = [
    ("2022-02-19T22:37:44.130", (6861.897826, -934.3811016, -14.66851920), (-0.1222573311, -1.009655310, 7.525523775)),
    ("2022-04-07T21:42:49.300", (5387.702395, 4384.530827, -11.64048825), (0.6474313881, -0.7969563504, 7.500478986)),
]


@pytest.fixture(scope="module")
def day() -> tuple[Times, Floats]:
    """Times over a day and places at 6900 km in all directions."""
    t_utc = np.datetime64("2022-02-19T22:37:44.130", "ns") + np.arange(0, 86400, 100).astype("timedelta64[s]")
    places = np.random.default_rng(1).normal(size=(len(t_utc), 3))
    return t_utc, 6900.0 * places / np.linalg.norm(places, axis=1)[:, None]


def _astropy_km(t_utc: Times, r_km: Floats, from_frame: str, to_frame: str) -> Floats:
    times = Time(t_utc, scale="utc")
    place = coordinates.CartesianRepresentation(r_km.T * units.km)
    start = getattr(coordinates, from_frame)(place, obstime=times)
    end = start.transform_to(getattr(coordinates, to_frame)(obstime=times))
    return np.asarray(end.cartesian.xyz.to_value(units.km).T)


def test_teme_to_itrf_agrees_with_astropy_to_2_cm_over_a_day(day: tuple[Times, Floats], offline_astropy: None) -> None:
    t_utc, r_km = day
    np.testing.assert_allclose(
        frames.teme_to_itrf(t_utc, r_km), _astropy_km(t_utc, r_km, "TEME", "ITRS"), rtol=0, atol=2e-5
    )


def test_teme_to_gcrf_agrees_with_astropy_to_1_mm(day: tuple[Times, Floats], offline_astropy: None) -> None:
    t_utc, r_km = day
    np.testing.assert_allclose(
        frames.teme_to_gcrf(t_utc, r_km), _astropy_km(t_utc, r_km, "TEME", "GCRS"), rtol=0, atol=1e-6
    )


def test_gcrf_to_itrf_is_the_full_iau_2006_2000a_series(day: tuple[Times, Floats]) -> None:
    """`erfa.c2t06a` at every instant; 1e-11 is 0.07 mm in a low orbit."""
    t_utc = day[0][::20]
    table = earth_orientation()
    want = erfa.c2t06a(*julian_tt(t_utc), *table.julian_ut1(t_utc), *table.polar_motion_rad(t_utc))
    np.testing.assert_allclose(frames.gcrf_to_itrf_matrix(t_utc), want, rtol=0, atol=1e-11)


def test_pole_interpolates_to_the_full_series_over_decades() -> None:
    """1e-12 rad is 0.007 mm in a low orbit."""
    rng = np.random.default_rng(2)
    t_utc = np.datetime64("1973-01-03", "ns") + rng.integers(0, 54 * 365 * 86400, 300).astype("timedelta64[s]")
    want = np.stack(erfa.xys06a(*julian_tt(t_utc)))
    np.testing.assert_allclose(np.stack(frames.cip_coordinates(t_utc)), want, rtol=0, atol=1e-12)


@pytest.mark.parametrize("number", [0, 1])
def test_dekart_tle_gives_the_papers_state_in_j2000(number: int, data_dir: Path) -> None:
    """DEKART Table: 5 cm covers the nine digits of the printed state and the rounded mean elements."""
    lines = (data_dir / "dekart.tle.txt").read_text().splitlines()[3 * number : 3 * number + 3]
    satellite = Satrec.twoline2rv(lines[1], lines[2])
    _, r_teme_km, v_teme_km_s = satellite.sgp4(satellite.jdsatepoch, satellite.jdsatepochF)
    epoch, r_j2000_km, v_j2000_km_s = DEKART_STATES[number]
    t_utc = np.array([epoch], "datetime64[ns]")
    r_km, v_km_s = frames.convert_state(t_utc, np.array([r_teme_km]), np.array([v_teme_km_s]), "TEME", "J2000")
    np.testing.assert_allclose(r_km[0], r_j2000_km, rtol=0, atol=5e-5)
    np.testing.assert_allclose(v_km_s[0], v_j2000_km_s, rtol=0, atol=1e-7)
    np.testing.assert_allclose(frames.teme_to_j2000(t_utc, np.array([r_teme_km])), r_km, rtol=0, atol=1e-9)


def test_j2000_of_fk5_is_metres_from_gcrf(day: tuple[Times, Floats]) -> None:
    """The two reductions differ by 1.3 to 1.4 m at the DEKART epochs: neither the same frame nor a wrong one."""
    t_utc, r_km = day
    apart_m = 1e3 * np.linalg.norm(frames.convert_position(t_utc, r_km, "J2000", "GCRF") - r_km, axis=1)
    assert 0.1 < apart_m.max() < 3.0


def test_eme2000_is_gcrf_less_the_frame_bias(day: tuple[Times, Floats]) -> None:
    """The bias is 17 to 23 mas about three axes: 0.6 to 0.9 m at 6900 km (IERS2010, 5.4.4)."""
    t_utc, r_km = day
    apart_m = 1e3 * np.linalg.norm(frames.convert_position(t_utc, r_km, "EME2000", "GCRF") - r_km, axis=1)
    assert 0.6 < apart_m.max() < 0.9


def test_eme2000_is_turned_from_gcrf_as_published(day: tuple[Times, Floats]) -> None:
    """IERS2010, 5.4.4: 14.6 mas about the pole, 16.617 and 6.8192 mas of the pole itself; what is left out is 1e-14."""
    right_ascension, xi, eta = np.deg2rad(np.array([-14.6, -16.617, -6.8192]) / 3.6e6)
    bias = np.array([[1.0, right_ascension, -xi], [-right_ascension, 1.0, -eta], [xi, eta, 1.0]])
    t_utc, r_km = day[0][:3], 7000.0 * np.eye(3)
    np.testing.assert_allclose(frames.convert_position(t_utc, r_km, "GCRF", "EME2000"), r_km @ bias.T, atol=1e-8)


@pytest.mark.parametrize(("start", "end"), list(product(frames.FRAMES, repeat=2)))
def test_states_come_back_from_every_frame(start: frames.Frame, end: frames.Frame, day: tuple[Times, Floats]) -> None:
    t_utc, r_km = day
    v_km_s = np.random.default_rng(3).normal(size=r_km.shape)
    there = frames.convert_state(t_utc, r_km, v_km_s, start, end)
    r_back_km, v_back_km_s = frames.convert_state(t_utc, *there, end, start)
    np.testing.assert_allclose(r_back_km, r_km, rtol=0, atol=1e-9)
    np.testing.assert_allclose(v_back_km_s, v_km_s, rtol=0, atol=1e-12)


@pytest.mark.parametrize("inertial", ["GCRF", "TEME"])
def test_velocity_in_itrf_is_the_derivative_of_the_position(inertial: frames.Frame) -> None:
    """A straight path in inertial space, central difference over 2 s; the precession of TEME is 5e-8 km/s."""
    middle = np.datetime64("2022-04-07T12:00:00", "ns")
    t_utc = middle + np.array([-1, 0, 1]).astype("timedelta64[s]")
    r_km, v_km_s = np.array([5387.7, 4384.5, -811.6]), np.array([0.6474, -0.7970, 7.5005])
    r_itrf_km = frames.convert_position(t_utc, r_km + np.array([[-1.0], [0.0], [1.0]]) * v_km_s, inertial, "ITRF")
    _, v_itrf_km_s = frames.convert_state(t_utc[1:2], r_km[None], v_km_s[None], inertial, "ITRF")
    np.testing.assert_allclose(v_itrf_km_s[0], (r_itrf_km[2] - r_itrf_km[0]) / 2.0, rtol=0, atol=6e-8)


def test_an_earth_fixed_point_stands_still_in_itrf_and_moves_east_in_gcrf() -> None:
    """465.1 m/s at the equator: the Earth's rate times 6378.137 km."""
    t_utc = np.array(["2022-02-19T12:00"], "datetime64[ns]")
    _, v_gcrf_km_s = frames.convert_state(t_utc, np.array([[6378.137, 0.0, 0.0]]), np.zeros((1, 3)), "ITRF", "GCRF")
    assert np.linalg.norm(v_gcrf_km_s) == pytest.approx(0.46510, abs=1e-5)


def test_an_unknown_frame_is_refused_by_name(day: tuple[Times, Floats]) -> None:
    with pytest.raises(FrameError, match="'MOD'"):
        frames.convert_position(*day, "MOD", "ITRF")  # type: ignore[arg-type]
