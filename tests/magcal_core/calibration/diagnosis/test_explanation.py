"""What comes near is no cause: smooth differences, quadrics that are no sensor, and zones behind better minima."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.diagnosis import search
from magcal_core.calibration.diagnosis.explanation import Rows
from magcal_core.calibration.diagnosis.other_orbits import Track
from magcal_core.calibration.diagnosis.search import Circumstances, diagnosis_of
from magcal_core.field.igrf import Igrf
from tests.magcal_core.fresh import fresh, fresh_orbit
from tests.magcal_core.garbage import spoiled


def causes_of(flown, orbit, *, shift_s=0.0, samples=None):
    """The codes that a diagnosis finds of a session read at a clock that is ``shift_s`` late, under ``orbit``."""
    one = flown.samples if samples is None else samples
    t_utc = one.t_utc + np.timedelta64(round(shift_s * 1e9), "ns")
    b_nt = Track(orbit, t_utc, Igrf()).field_nt(np.zeros(1))[0]
    told = replace(one, t_utc=t_utc, b_ref_magnitude_nt=b_nt, b_ref_base_nt=None)
    return diagnosis_of(Circumstances(told, orbit, Igrf())).findings


def test_readings_that_say_nothing_of_a_field_that_hardly_varies_are_no_sensor():
    """The constant of the quadric explains 0.5 % of variation with gains of next to nothing."""
    rng = np.random.default_rng(5)
    b_nt = 30_000.0 * (1.0 + 0.005 * np.sin(np.linspace(0.0, 9.0, 240)))
    noise = Rows.of(rng.normal(scale=3e4, size=(240, 3))).explanation(b_nt)
    assert noise.scale < 0.02
    assert not noise.is_sound
    u = rng.normal(size=(240, 3))
    true = Rows.of(b_nt[:, None] * u / np.linalg.norm(u, axis=1, keepdims=True) + 2000.0).explanation(b_nt)
    assert true.is_sound


@pytest.mark.parametrize("kind", ["spikes of 10 uT", "axis inverted", "random numbers"])
def test_what_good_rows_leave_is_noise_whatever_the_others_hold(kind):
    flown = fresh(77)
    samples, _ = spoiled(flown, kind, 0.3, 1)
    found = Rows.of(samples.h_nt[::3]).explanation(flown.samples.b_ref_magnitude_nt[::3])
    assert abs(found.neighbours) < 0.25
    assert not found.is_coloured
    (cause,) = causes_of(flown, flown.orbit, samples=replace(samples, b_ref_base_nt=None))
    assert cause.code == "bad_rows"


@pytest.mark.parametrize("seed", [5600, 310603, 320600])
def test_a_short_session_of_an_unknown_satellite_is_unexplained(seed):
    """Forty minutes: some hour's field comes within 1 %, of all rows or of some, and leaves a smooth difference."""
    flown = fresh(seed)
    (cause,) = causes_of(flown, fresh_orbit(flown.random, flown.samples.t_utc[0]))
    assert cause.code == "unexplained"


def test_a_time_zone_is_found_behind_the_minima_of_a_short_session():
    """Under a clock that is 11 h off a sensor explains more than half of the rows: no bad rows, but the clock."""
    flown = fresh(5101)
    (cause,) = causes_of(flown, flown.orbit, shift_s=-39_600.0)
    assert cause.code == "clock"
    assert cause.value == pytest.approx(39_600.0, abs=30.0)


def test_half_of_few_rows_lie_near_by_chance_and_the_others_are_not_bad():
    """270 rows, 0.6 % of noise: ten unknowns leave half of them 0.4 %, and a fifth beyond five times that."""
    flown = fresh(310400)
    assert causes_of(flown, flown.orbit) == ()


def test_no_other_clock_is_looked_for_where_good_rows_leave_noise(monkeypatch):
    """Of rows that are bad the cause is known: scans of clocks and orbits would cost a hundred times as much."""
    flown = fresh(78)
    samples, _ = spoiled(flown, "random numbers", 0.3, 1)
    monkeypatch.setattr(search, "_candidates", None)
    (cause,) = causes_of(flown, flown.orbit, samples=replace(samples, b_ref_base_nt=None))
    assert cause.code == "bad_rows"
