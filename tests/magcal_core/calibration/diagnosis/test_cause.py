"""The cause of a failure has its name: planted faults of rows, axes, unit, clock and orbit, on missions drawn here."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from magcal_core.errors import MagcalError, WrongInputError
from magcal_core.orbit import Orbit
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.missions import DisplacedOrbit, draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

START = np.datetime64("2022-03-01T06:00:00", "ns")


@dataclass(frozen=True)
class Flown:
    """One session, the orbit it was flown on, and the draws of its test."""

    samples: Samples
    orbit: Orbit
    rng: np.random.Generator


def fly(seed, noise_nt=60.0):
    rng = np.random.default_rng([seed, 41])
    orbit = draw_orbit(rng, START)
    sensor = SensorModel(rng.uniform(-15000, 15000, 3), rng.uniform(0.9, 1.1, 3), rng.uniform(-4, 4, 3))
    made = simulate(orbit, sensor, START, 7000.0, 10.0, disturbances=Disturbances(noise_nt=noise_nt), seed=seed)
    return Flown(replace(made.samples, q_base_gcrf=None), orbit, rng)


@pytest.fixture(scope="module")
def flown():
    return [fly(seed) for seed in (101, 102)]


def later(samples, seconds):
    return replace(samples, t_utc=samples.t_utc + np.timedelta64(round(seconds * 1e9), "ns"))


def diagnosis(samples, orbits, **options):
    """The diagnosis of a calibration that is given, or that is refused."""
    try:
        return calibrate(samples, orbits, **options).extras["diagnosis"]
    except MagcalError as error:
        assert error.data_quality["rows"] == len(samples)
        return error.diagnosis


def first(found):
    return found["findings"][0] if found and found["findings"] else {"code": None}


@pytest.mark.parametrize("hours", [2.0, -5.5, 11.0])
def test_local_time_is_a_clock_and_its_zone_goes_first(flown, hours):
    for one in flown:
        found = first(diagnosis(later(one.samples, 3600 * hours), [one.orbit]))
        assert found["code"] == "clock", found
        assert found["value"] == pytest.approx(-3600 * hours, abs=30)
        assert "local time" in found["text"]


@pytest.mark.parametrize("seconds", [40.0, 700.0, -20000.0])
def test_a_clock_that_is_off_is_found_to_seconds(flown, seconds):
    for one in flown:
        found = first(diagnosis(later(one.samples, seconds), [one.orbit], time_offset="none"))
        assert found["code"] in ("clock", "along_track"), found
        assert abs(found["value"] + seconds) < 5.0 or f"{-seconds:.0f}" in str(found["alternatives"])


def test_an_offset_of_a_minute_that_is_taken_unasked_and_right_needs_no_cause(flown):
    got = calibrate(later(flown[1].samples, 80.0), [flown[1].orbit])
    assert got.extras["diagnosis"] is None
    assert got.verdict.grade == "accept"
    assert got.extras["time_offset"]["offset_s"] == pytest.approx(-80.0, abs=5.0)


def test_the_error_names_the_cause_first_and_says_not_observable_no_more(flown):
    with pytest.raises(WrongInputError, match=r"^clock: -?\d+ s, local time taken for UTC\?") as caught:
        calibrate(later(flown[0].samples, 7200.0), [flown[0].orbit])
    assert caught.value.code == "wrong_input"


def test_a_place_far_along_the_track_is_told(flown):
    for one in flown:
        off = DisplacedOrbit(one.orbit, START, 0.0, 1500.0, 0.0)
        found = diagnosis(one.samples, [off])
        assert first(found)["code"] in ("along_track", "clock", "orbit_plane"), found


def test_another_satellite_is_named_where_its_orbit_is_among_the_candidates(flown):
    for i, one in enumerate(flown):
        other = fly(200 + i).orbit
        found = diagnosis(one.samples, [other], candidates=[fly(300).orbit, one.orbit])
        assert first(found)["code"] == "wrong_satellite", found
        assert first(found)["text"].startswith("the orbit of ")
        alone = first(diagnosis(one.samples, [other]))
        assert alone["code"] in ("unexplained", "orbit_plane", "clock"), alone


def test_rows_axes_and_unit_are_told_without_any_scan(flown):
    for one in flown:
        h = one.samples.h_nt
        axis = int(one.rng.integers(3))
        still, noisy = h.copy(), h.copy()
        still[:, axis] = still[0, axis]
        noisy[:, axis] = 300.0 * one.rng.normal(size=len(h))
        cases = {
            "axis_constant": [still, noisy],
            "sensor_constant": [
                np.tile(h[0], (len(h), 1)),
                h[0] + 40.0 * one.rng.normal(size=h.shape),
            ],
            "unit": [100.0 * h, 1e-3 * h],
        }
        for code, readings in cases.items():
            for reading in readings:
                found = diagnosis(replace(one.samples, h_nt=reading), [one.orbit])
                assert first(found)["code"] == code, (code, found)


def test_noise_in_place_of_a_sensor_and_shuffled_rows_have_no_cause(flown):
    for one in flown:
        h = one.samples.h_nt
        for reading in (one.rng.normal(scale=3e4, size=h.shape), h[one.rng.permutation(len(h))]):
            found = diagnosis(replace(one.samples, h_nt=reading), [one.orbit])
            assert first(found)["code"] == "unexplained", found


@pytest.mark.parametrize("noise_nt", [60.0, 400.0])
def test_good_sessions_have_no_cause(noise_nt):
    for seed in (401, 402):
        one = fly(seed, noise_nt)
        got = calibrate(one.samples, [one.orbit])
        assert first(got.extras["diagnosis"])["code"] is None, got.extras["diagnosis"]


def test_bad_rows_are_the_cause_of_a_session_full_of_them(flown):
    one = flown[0]
    h = one.samples.h_nt.copy()
    bad = one.rng.choice(len(h), int(0.55 * len(h)), replace=False)
    h[bad] = one.rng.uniform(-60000, 60000, (len(bad), 3))
    found = diagnosis(replace(one.samples, h_nt=h), [one.orbit])
    assert first(found)["code"] in ("bad_rows", "unexplained"), found
