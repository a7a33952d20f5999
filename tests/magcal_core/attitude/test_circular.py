import numpy as np
import pytest

from magcal_core.attitude.circular import CircularOrbit
from magcal_core.errors import InputError
from magcal_core.field.models import field_model

T0 = np.array([0.0])


def test_rate_at_500_km_is_the_papers():
    assert CircularOrbit(altitude_km=500.0).rate_rad_s == pytest.approx(1.10678e-3, abs=1e-8)


def test_axes_are_along_the_motion_up_and_against_the_orbit_normal():
    orbit = CircularOrbit(inclination_rad=np.deg2rad(62.0), u0_rad=0.7, raan_rad=1.1)
    along, up, third = orbit.rot_osk_isk(T0)[0]
    step = 1e-3
    moved = (orbit.rot_osk_isk(T0 + step)[0, 1] - orbit.rot_osk_isk(T0 - step)[0, 1]) / (2 * step)
    np.testing.assert_allclose(moved / np.linalg.norm(moved), along, atol=1e-7)  # central difference
    np.testing.assert_allclose(np.cross(along, up), third, atol=1e-12)
    assert third[2] == pytest.approx(-np.cos(np.deg2rad(62.0)))


def test_direct_dipole_at_62_deg_of_latitude_is_as_strong_as_the_closed_form():
    """B0 (R / r)^3 sqrt(1 + 3 sin^2 latitude), 43.6 uT (ROM, section 1)."""
    orbit = CircularOrbit(inclination_rad=np.deg2rad(62.0), u0_rad=np.pi / 2)
    b_nt = orbit.field_osk_nt(field_model("dipole"), T0)[0]
    want = 30036.0 * (6371.2 / orbit.radius_km) ** 3 * np.sqrt(1.0 + 3.0 * np.sin(np.deg2rad(62.0)) ** 2)
    assert np.linalg.norm(b_nt) == pytest.approx(want, rel=2e-3)
    assert np.linalg.norm(b_nt) == pytest.approx(43_600.0, rel=5e-3)
    assert b_nt[1] < 0.0  # the field points down in the north


def test_the_earth_turns_under_the_orbit_with_the_epoch():
    """Half a sidereal day later Greenwich is on the other side: the same field as with the node turned by 180 deg."""
    igrf, start = field_model("igrf"), np.datetime64("2020-01-01T00:00:00", "ns")
    later = start + np.timedelta64(43_082_045_500_000 // 1000, "us").astype("timedelta64[ns]")
    one = CircularOrbit(epoch_utc=later).field_osk_nt(igrf, T0)
    other = CircularOrbit(epoch_utc=start, raan_rad=np.pi).field_osk_nt(igrf, T0)
    np.testing.assert_allclose(one, other, atol=5.0)  # half a day of secular variation, 0.001 deg of angle


def test_a_given_greenwich_angle_takes_the_place_of_the_epochs():
    igrf = field_model("igrf")
    one = CircularOrbit(greenwich_rad=0.3).field_osk_nt(igrf, T0)
    other = CircularOrbit(greenwich_rad=0.0, raan_rad=-0.3).field_osk_nt(igrf, T0)
    np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize("wrong", [{"altitude_km": 50.0}, {"inclination_rad": 3.2}, {"u0_rad": np.nan}])
def test_an_orbit_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError):
        CircularOrbit(**wrong)
