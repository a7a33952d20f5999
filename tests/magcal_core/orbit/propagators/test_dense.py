"""The fast ways to a position against the slow ones."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.errors import ModelRangeError, PropagationError
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast, teme_to_itrf_fast
from magcal_core.orbit.earth.eop import earth_orientation
from magcal_core.orbit.earth.frames import itrf_to_gcrf, teme_to_itrf
from magcal_core.orbit.earth.timescales import julian_utc
from magcal_core.orbit.messages.tle import checksum
from magcal_core.orbit.propagators.dense import interpolated, interval_ns
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

Floats = NDArray[np.float64]

MOLNIYA = (
    "1 25847U 99036A   22050.50000000  .00000000  00000-0  00000+0 0  999",
    "2 25847  63.4000 120.0000 7300000 270.0000  10.0000  2.00600000    0",
)
LOW = (
    "1 00001U          22050.50000000  .00010000  00000-0  50000-3 0  999",
    "2 00001  51.6000 120.0000 0010000  90.0000  10.0000 15.80000000    0",
)
DECAYING = (
    "1 00002U          22050.50000000  .10000000  00000-0  50000-2 0  999",
    "2 00002  51.6000 120.0000 0010000  90.0000  10.0000 16.35000000    0",
)


def _orbit(lines: tuple[str, str]) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join(line.ljust(68) + str(checksum(line)) for line in lines))


@pytest.fixture(scope="module")
def dekart(data_dir: Path) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))


def _slow(orbit: Sgp4Orbit, t_utc: NDArray[np.datetime64]) -> Floats:
    return teme_to_itrf(t_utc, orbit.state_teme(t_utc)[0])


@pytest.fixture(scope="module", params=range(3))
def half_a_century(request: pytest.FixtureRequest) -> tuple[NDArray[np.datetime64], Floats]:
    """Unsorted times, leap seconds, midnights and the ends of the table among them, and places of 7000 km."""
    rng = np.random.default_rng(request.param)
    t_utc = np.datetime64("1973-01-02", "ns") + rng.integers(0, 54 * 365 * 86_400_000, 1000).astype("timedelta64[ms]")
    special = ["1973-01-02", "2016-12-31T23:59:59.999", "2017-01-01", "2022-02-19T23:59:59.999999999", "2022-02-20"]
    t_utc[:6] = np.array([*special, "2000-01-01T12"], "datetime64[ns]")
    t_utc[6] = earth_orientation().last
    return t_utc, rng.normal(size=(1000, 3)) * 4000.0


def test_fast_teme_to_itrf_is_the_slow_one(half_a_century: tuple[NDArray[np.datetime64], Floats]) -> None:
    """1e-8 km: rounding of the angle at 7000 km."""
    np.testing.assert_allclose(teme_to_itrf_fast(*half_a_century), teme_to_itrf(*half_a_century), rtol=0, atol=1e-8)


def test_fast_itrf_to_gcrf_is_the_slow_one(half_a_century: tuple[NDArray[np.datetime64], Floats]) -> None:
    """1e-8 km: 1e-12 rad between the nodes of the pole's path."""
    np.testing.assert_allclose(itrf_to_gcrf_fast(*half_a_century), itrf_to_gcrf(*half_a_century), rtol=0, atol=1e-8)


def test_the_fast_rotation_reaches_the_end_of_the_table_and_no_further() -> None:
    r_km = np.full((1, 3), 4000.0)
    with pytest.raises(ModelRangeError, match="Earth orientation"):
        teme_to_itrf_fast(np.array(["2050-01-01"], "datetime64[ns]"), r_km)
    for rotate in (teme_to_itrf_fast, itrf_to_gcrf_fast):
        assert rotate(np.zeros(0, "datetime64[ns]"), np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize("step_ms", [100, 1000, 10_000, 20_000])
def test_dense_positions_of_a_low_orbit_are_within_a_millimetre(step_ms: int, dekart: Sgp4Orbit) -> None:
    t_utc = dekart.epoch_utc + (np.arange(-2000, 8000) * step_ms).astype("timedelta64[ms]")
    np.testing.assert_allclose(dekart.position_itrf_km(t_utc), _slow(dekart, t_utc), rtol=0, atol=1e-6)


@pytest.mark.parametrize("lines", [MOLNIYA, LOW])
def test_dense_positions_of_any_orbit_are_within_a_centimetre(lines: tuple[str, str]) -> None:
    """Two revolutions of an eccentric deep-space orbit; a low orbit with drag over a day."""
    orbit = _orbit(lines)
    t_utc = orbit.epoch_utc + (np.arange(86_000)).astype("timedelta64[s]")
    np.testing.assert_allclose(orbit.position_itrf_km(t_utc), _slow(orbit, t_utc), rtol=0, atol=1e-5)


def test_order_gaps_and_repetition_do_not_matter(dekart: Sgp4Orbit) -> None:
    """Sessions months apart, shuffled, with repeated times: each time has the position that it has alone, to 1 mm."""
    rng = np.random.default_rng(0)
    days = np.concatenate([rng.uniform(0, 0.2, 4000), rng.uniform(9.0, 9.2, 4000), np.full(200, 3.0)])
    t_utc = dekart.epoch_utc + (rng.permutation(days) * 86400e9).astype("timedelta64[ns]")
    found_km = dekart.position_itrf_km(t_utc)
    np.testing.assert_allclose(found_km, _slow(dekart, t_utc), rtol=0, atol=1e-6)
    backwards_km = dekart.position_itrf_km(t_utc[::-1])
    np.testing.assert_array_equal(backwards_km[::-1], found_km)


def test_few_or_scattered_samples_are_not_interpolated(dekart: Sgp4Orbit) -> None:
    epoch_ns = int(dekart.epoch_utc.astype(np.int64))
    step_ns = interval_ns(dekart.elements.perigee_km, dekart.elements.apogee_km)

    asked: list[int] = []

    def values(stamps_ns: NDArray[np.int64]) -> Floats:
        asked.append(len(stamps_ns))
        return np.zeros((len(stamps_ns), 3))

    for spacing_s, n in ((1, 999), (100, 5000), (100_000, 5000)):
        stamps = epoch_ns + np.arange(n) * spacing_s * 10**9
        assert interpolated(stamps, epoch_ns, step_ns, values) is None
    assert asked == []
    assert interpolated(epoch_ns + np.arange(5000) * 10**9, epoch_ns, step_ns, values) is not None
    assert asked == [43 + 11]


def test_the_last_minutes_before_the_ground_need_no_node_behind_it() -> None:
    """No position is given 50 km below the perigee of a TLE: samples up to the last second before have theirs."""
    orbit = _orbit(DECAYING)
    later = orbit.epoch_utc + np.arange(86400).astype("timedelta64[s]")
    radius_km = np.linalg.norm(orbit.elements.satrec().sgp4_array(*julian_utc(later))[1], axis=1)
    until = later[int(np.argmax(radius_km < orbit.elements.perigee_km - 50.0)) - 1]
    t_utc = until - np.arange(3000)[::-1].astype("timedelta64[s]")
    np.testing.assert_allclose(orbit.position_itrf_km(t_utc), _slow(orbit, t_utc), rtol=0, atol=1e-8)
    with pytest.raises(PropagationError):
        orbit.position_itrf_km(t_utc + np.timedelta64(1, "s"))


def test_the_distance_of_nodes_follows_the_speed_at_the_perigee() -> None:
    """0.13 rad of a 6900 km circle at 7.6 km/s is 118 s; at the perigee of a Molniya orbit, 9.8 km/s, 94.9 s."""
    assert interval_ns(6900.0, 6900.0) == 118 * 10**9
    assert interval_ns(7170.0, 45900.0) == pytest.approx(94 * 10**9, abs=2 * 10**9)
