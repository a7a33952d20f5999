"""SGP4 orbits: the outputs that must pass, and those that must not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sgp4.api import Satrec

from magcal_core.errors import PropagationError, TimeError, TleFormatError
from magcal_core.orbit.messages.tle import checksum, parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit


@pytest.fixture(scope="module")
def text(data_dir: Path) -> str:
    return "\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3])


def _hours(orbit: Sgp4Orbit, hours: float, n: int = 50) -> np.ndarray:
    return orbit.epoch_utc + (np.linspace(0, hours, n) * 3.6e12).astype("timedelta64[ns]")


def _with(line: str, first: int, text: str) -> str:
    body = (line[: first - 1] + text + line[first - 1 + len(text) :])[:68]
    return body + str(checksum(body))


def test_positions_are_those_of_sgp4_one_by_one(text: str) -> None:
    """The scalar call of the library, from the TLE's own epoch; 1e-6 km covers the rounding of the Julian date."""
    orbit = Sgp4Orbit.from_tle(text)
    lines = text.splitlines()
    satellite = Satrec.twoline2rv(lines[1], lines[2])
    t_utc = _hours(orbit, 48)
    minutes = (t_utc - orbit.epoch_utc) / np.timedelta64(1, "m")
    want = np.array([satellite.sgp4_tsince(minute)[1:] for minute in minutes])
    r_km, v_km_s = orbit.state_teme(t_utc)
    np.testing.assert_allclose(r_km, want[:, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(v_km_s, want[:, 1], rtol=0, atol=1e-9)


def test_itrf_and_gcrf_states_have_the_same_length_and_the_orbits_model(text: str) -> None:
    orbit = Sgp4Orbit.from_tle(text)
    t_utc = _hours(orbit, 3)
    r_gcrf_km, _ = orbit.state_gcrf(t_utc)
    r_itrf_km, v_itrf_km_s = orbit.state_itrf(t_utc)
    np.testing.assert_allclose(orbit.position_itrf_km(t_utc), r_itrf_km, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(r_gcrf_km, axis=1), np.linalg.norm(r_itrf_km, axis=1), rtol=1e-13)
    assert v_itrf_km_s.shape == (50, 3)
    assert orbit.model == "sgp4"
    assert orbit.epoch_utc == np.datetime64("2022-02-19T22:37:44.129568")


def test_a_decayed_satellite_is_an_error_with_code_epoch_and_time(text: str) -> None:
    """B* of 1 per Earth radius brings the satellite down within weeks."""
    tle = parse_tles(text)[0]
    falling = replace(tle, line1=_with(tle.line1, 54, " 99999+0"))
    orbit = Sgp4Orbit(falling)
    with pytest.raises(PropagationError, match=r"SGP4 code [1-6] .*epoch 2022-02-19T22:37:44\.129Z, at 2022-"):
        orbit.position_itrf_km(_hours(orbit, 2000))


def test_a_position_outside_perigee_and_apogee_is_an_error(text: str) -> None:
    """The library answers with error 0 and a position that the elements cannot have."""
    orbit = Sgp4Orbit(replace(parse_tles(text)[0], perigee_km=6990.0, apogee_km=7010.0))
    with pytest.raises(PropagationError, match=r"radius 69\d\d\.\d km is outside 6940\.0 to 7060\.0 km"):
        orbit.state_teme(_hours(orbit, 3))


def test_elements_that_sgp4_refuses_are_refused_at_once(text: str) -> None:
    tle = parse_tles(text)[0]
    with pytest.raises(PropagationError, match="SGP4 code 2"):
        Sgp4Orbit(replace(tle, line2=_with(tle.line2, 53, " 0.00000000")))


def test_not_a_time_is_refused_before_sgp4_sees_it(text: str) -> None:
    with pytest.raises(TimeError, match="NaT"):
        Sgp4Orbit.from_tle(text).state_gcrf(np.array(["NaT"], "datetime64[ns]"))


def test_from_tle_wants_one_tle(data_dir: Path) -> None:
    with pytest.raises(TleFormatError, match="2 TLEs"):
        Sgp4Orbit.from_tle((data_dir / "dekart.tle.txt").read_text())


def test_no_times_give_no_positions(text: str) -> None:
    assert Sgp4Orbit.from_tle(text).position_itrf_km(np.zeros(0, "datetime64[ns]")).shape == (0, 3)
