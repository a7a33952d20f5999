"""A small part of the population, seeds fixed; `python -m benchmarks population` runs forty missions a kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.missions import _tle_text, draw_mission
from magcal_core.simulation.population import (
    TOLERANCE,
    Outcome,
    by_kind,
    effective_truth,
    expected_share,
    largest_error_share,
    rates_of,
    run_mission,
)

SEEDS = range(300, 316)


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return [run_mission(draw_mission(seed)) for seed in SEEDS]


def test_verdicts_and_intervals_hold_over_a_part_of_the_population(outcomes: list[Outcome]) -> None:
    """Limits for 16 missions, 3 sigma of the binomial around the rates of two thousand (`docs/trust.md`)."""
    rates = rates_of(outcomes)
    assert rates.missions == len(SEEDS)
    assert rates.accepted >= 2
    assert rates.refused >= 1
    assert 0.80 <= rates.coverage <= 1.0
    assert rates.bad_among_accepted == 0.0
    assert rates.good_refused <= 0.35 * rates.good


def test_the_worst_kind_comes_first(outcomes: list[Outcome]) -> None:
    """One bad calibration that was accepted is worse than intervals that do not hold."""
    missed = np.zeros(9, dtype=bool)
    sound = replace(outcomes[0], kind="sound", grade="accept", error_share=0.0, is_covered=~missed, distance=9.0)
    wide = replace(sound, kind="wide", is_covered=missed)
    bad = replace(sound, kind="bad", error_share=2.0 * TOLERANCE)
    silent = replace(sound, kind="silent", grade="refuse", is_covered=None, distance=None)
    ordered = by_kind([sound, silent, wide, bad])
    assert [kind for kind, _ in ordered] == ["bad", "wide", "sound", "silent"]
    assert [rates.bad_accepted for _, rates in ordered] == [1, 0, 0, 0]


def test_the_same_seed_is_the_same_mission_with_the_same_outcome(outcomes: list[Outcome]) -> None:
    again = run_mission(draw_mission(SEEDS[0]))
    assert (again.grade, again.reasons, again.error_share) == (
        outcomes[0].grade,
        outcomes[0].reasons,
        outcomes[0].error_share,
    )


def test_every_drawn_orbit_is_a_sound_tle() -> None:
    random = np.random.default_rng(1)
    for day in range(0, 1400, 23):
        start = np.datetime64("2021-01-01T05:00:00", "ns") + np.timedelta64(day, "D")
        (tle,) = parse_tles(_tle_text(random, start))
        assert abs(tle.epoch_utc - start) < np.timedelta64(2, "s")
        assert 300.0 - 60.0 < tle.perigee_km - 6378.0 < 1260.0


def test_a_displaced_orbit_is_late_along_track() -> None:
    mission = draw_mission(4)
    orbit = mission.orbits[0]
    t_utc = mission.samples.t_utc[:5]
    r_true, v_true = orbit.true.state_gcrf(t_utc)
    moved = orbit.state_gcrf(t_utc)[0] - r_true
    along = np.sum(moved * v_true, axis=1) / np.linalg.norm(v_true, axis=1)
    assert np.linalg.norm(moved, axis=1) == pytest.approx(np.abs(along), rel=1e-2)
    assert along == pytest.approx(-orbit.late_s * np.linalg.norm(v_true, axis=1), rel=0.02, abs=0.1)


def test_the_largest_error_is_that_of_a_known_bias() -> None:
    """A bias that is 400 nT off along one axis of an ideal sensor is 1 % of 40 uT, wherever the field points."""
    truth = SensorModel(np.zeros(3), np.ones(3), np.zeros(3))
    off = Parameters(np.array([400.0, 0.0, 0.0]), np.ones(3), np.zeros(3))
    assert largest_error_share(off, truth) == pytest.approx(0.01)
    assert largest_error_share(replace(off, bias_nt=np.zeros(3)), truth) == pytest.approx(0.0, abs=1e-12)


def test_the_expected_error_is_small_where_the_data_are_good_and_large_where_they_are_not() -> None:
    shares = {}
    for seed in range(60):
        mission = draw_mission(seed)
        if mission.options.method == "scalar" and mission.motion in {"tumbling", "still"}:
            shares.setdefault(mission.motion, []).append(expected_share(mission, effective_truth(mission)))
    assert np.median(shares["tumbling"]) < TOLERANCE < np.median(shares["still"])
