"""Light and heat through gaps of the samples, and rows in the sun that the loss rejects."""

import numpy as np
import pytest

from magcal_core.calibration.terms.heat_columns import TIME_CONSTANTS_S, heat_columns, light_along
from magcal_core.calibration.terms.odd_light import odd_light
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.telemetry import read_samples

START = np.datetime64("2022-04-08T00:00:00", "ns")
SECOND = np.timedelta64(1, "s")


@pytest.fixture(scope="module")
def orbit(data_dir):
    """An orbit with an eclipse of half an hour in every turn."""
    return Sgp4Orbit.from_tle((data_dir / "trust" / "heat_nadir.tle").read_text())


@pytest.fixture(scope="module")
def shadow(data_dir, orbit):
    """Times 10 s apart of three turns from the start of the session on, and the light then."""
    start = read_samples(data_dir / "trust" / "heat_nadir.csv").t_utc[0].astype("datetime64[ns]")
    t_utc = start + np.arange(1700) * 10 * SECOND
    light = light_along(t_utc, [orbit])
    assert 0.2 < np.mean(light == 0) < 0.5
    return t_utc, light


def decayed(t_s, light, tau_s):
    """Return the exact answer of y' = (light - y) / tau to light that is constant over each step, from its mean."""
    y = np.empty(len(light))
    y[0] = light.mean()
    for i in range(1, len(light)):
        y[i] = light[i] + (y[i - 1] - light[i]) * np.exp(-(t_s[i] - t_s[i - 1]) / tau_s)
    return y


def test_without_gaps_heat_is_the_answer_of_a_first_order_delay(shadow, orbit):
    """An orbit that is given beside changes nothing where there is no gap."""
    t_utc, light = shadow
    t_s = (t_utc - t_utc[0]) / SECOND
    made = heat_columns(t_utc, light, [orbit])
    for i, tau_s in enumerate(TIME_CONSTANTS_S):
        np.testing.assert_allclose(made[:, i], decayed(t_s, light, tau_s), atol=1e-12)
    np.testing.assert_array_equal(made, heat_columns(t_utc, light, []))


def test_samples_in_shadow_alone_still_feel_the_light_before(shadow, orbit):
    """Heat of samples in shadow alone is that of the whole orbit: light is followed through the gaps.

    Within 0.04 from the second turn on: light is followed at steps of 20 s, and at the start nothing is known.
    """
    t_utc, light = shadow
    t_s = (t_utc - t_utc[0]) / SECOND
    rows = np.flatnonzero(light == 0)
    made = heat_columns(t_utc[rows], light[rows], [orbit])
    later = t_s[rows] > t_s[rows][np.argmax(np.diff(t_s[rows]) > 600.0) + 1] - 1.0
    for i, tau_s in enumerate(TIME_CONSTANTS_S):
        whole = decayed(t_s, light, tau_s)[rows]
        assert np.abs(made[later, i] - whole[later]).max() < 0.04
    blind = heat_columns(t_utc[rows], light[rows], [])
    assert np.abs(blind).max() == 0.0


def test_an_orbit_of_another_year_tells_no_light(shadow, orbit):
    """Beyond sixty days light is not known any more."""
    t_utc, _ = shadow
    assert light_along(t_utc + np.timedelta64(200, "D"), [orbit]) is None


def test_rows_in_the_sun_are_odd_where_the_loss_rejects_half_of_them_and_none_in_shadow():
    """As on the real satellite: 28 of 60 in the sun, none of 543 in shadow."""
    light = np.zeros(603)
    light[::10][:60] = 1.0
    lit = np.flatnonzero(light)
    weights = np.ones(603)
    weights[lit[:28]] = 0.0
    found = odd_light(weights, light)
    assert found.is_sun
    assert (found.rejected, found.count, found.others_rejected, found.others) == (28, 60, 0, 543)
    np.testing.assert_array_equal(found.rows, light > 0)
    assert found.warning.startswith("odd_light")
    assert not odd_light(weights, 1.0 - light).is_sun


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_rows_that_are_bad_one_by_one_make_no_light_odd(share):
    """Of 300 sessions with bad rows wherever they fall none is split: the limit asks for a chance of 1e-6."""
    random = np.random.default_rng(20261130)
    light = np.where(np.arange(700) % 570 < 100, 0.0, 1.0)
    for _ in range(100):
        assert odd_light((random.random(700) > share).astype(float), light) is None


def test_a_light_that_most_rows_have_is_never_left_out():
    """Where most rows are rejected in the sun it is not they that are the exception."""
    light = np.where(np.arange(600) < 400, 1.0, 0.0)
    weights = np.where((np.arange(600) < 300), 0.0, 1.0)
    assert odd_light(weights, light) is None
