"""Every kind of the population: its physics against closed forms, what is sent against what was drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import conjugate, multiply, rotate, rotation_angle, unit
from magcal_core.calibration.terms.heat_columns import light_of, sun_gcrf
from magcal_core.field.igrf import Igrf
from magcal_core.numerics.sphere import even_directions
from magcal_core.orbit.earth.frames import gcrf_to_itrf
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.attitude_modes import MODES
from magcal_core.simulation.bias_errors import BIAS_ERRORS, followed, panel_currents, random_walk, torquer_columns
from magcal_core.simulation.electronics import ELECTRONICS, FULL_NT
from magcal_core.simulation.flight import Flight
from magcal_core.simulation.kinds import KIND_NAMES, KINDS, averaged_nt, draw_kind
from magcal_core.simulation.magnetic_motion import MagneticBody, integrated
from magcal_core.simulation.missions import FREE_MOTION, Mission, draw_orbit, draw_transfer_orbit
from magcal_core.simulation.population import effective_truth, largest_error_share, run_mission
from magcal_core.simulation.ranges import RANGES, Draws
from magcal_core.simulation.sample_times import SAMPLE_TIMES, SHADOW_STEP_S

SEED = 5
START = np.datetime64("2022-03-05T06:00:00", "ns")
FIELD_NT = np.array([12000.0, -7000.0, 31000.0])


@pytest.fixture(scope="module")
def drawn() -> dict[str, Mission]:
    return {name: draw_kind(name, SEED) for name in KIND_NAMES}


def flight_of(seed: int) -> Flight:
    return Flight(draw_orbit(np.random.default_rng(seed), START), Igrf(), START)


def draws_of(seed: int) -> Draws:
    return Draws(np.random.default_rng(seed))


def unit_rows(v: Floats) -> Floats:
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def angle_deg(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))))


# ---------------------------------------------------------------------------------------------------------- missions


def test_every_kind_is_drawn_with_its_figures_within_the_named_ranges(drawn: dict[str, Mission]) -> None:
    for name, mission in drawn.items():
        rows = len(mission.samples)
        assert mission.kind == name
        assert 10 <= rows == len(mission.b_base_nt) == len(mission.moved_nt) == len(mission.is_sound), name
        assert np.isfinite(mission.samples.h_nt).all(), name
        assert np.all(np.diff(mission.samples.t_utc) > np.timedelta64(0, "ns")), name
        for figure in mission.drawn.keys() & RANGES.keys():
            assert RANGES[figure].low <= mission.drawn[figure] <= RANGES[figure].high, (name, figure)


def test_every_mode_error_and_fault_is_in_a_kind() -> None:
    kinds = KINDS.values()
    assert {mode for kind in kinds for mode in kind.modes} == set(MODES)
    assert {error for kind in kinds for error in kind.errors} == set(BIAS_ERRORS)
    assert {kind.electronics for kind in kinds} - {""} == set(ELECTRONICS)
    assert {kind.times for kind in kinds} == set(SAMPLE_TIMES)


def test_the_same_seed_draws_the_same_mission_and_another_one_does_not() -> None:
    first, again, other = (draw_kind("quantised", seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.samples.h_nt, again.samples.h_nt)
    assert first.drawn == again.drawn
    assert not set(first.drawn.values()) & set(other.drawn.values())


@pytest.mark.parametrize(
    "name", [name for name in KIND_NAMES if name not in {FREE_MOTION, "one axis stuck throughout"}]
)
def test_sound_readings_are_the_sensor_of_the_true_field_to_noise(drawn: dict[str, Mission], name: str) -> None:
    """Within six standard deviations of the noise, beside what a mean over the interval or the coils take away."""
    mission = drawn[name]
    bent = mission.truth.apply(mission.b_base_nt) + mission.moved_nt
    bent = bent + mission.cubic_share * bent * (bent / FULL_NT) ** 2
    for name_of, column in mission.samples.housekeeping.items():
        assert name_of in mission.options.regressors
        assert set(np.unique(column)) <= {-1.0, 0.0, 1.0}
    columns = np.column_stack([*mission.samples.housekeeping.values(), np.zeros(len(bent))])
    left = (mission.samples.h_nt - bent)[mission.is_sound]
    left -= columns[mission.is_sound] @ np.linalg.lstsq(columns[mission.is_sound], left)[0]
    lost = 0.0
    if "interval_s" in mission.drawn:
        turn_deg = mission.drawn["interval_s"] * mission.drawn.get("spin_deg_s", mission.drawn.get("tumble_deg_s", 0.0))
        lost = 1.05 * np.deg2rad(turn_deg) ** 2 / 24.0 * 65000.0 * np.abs(mission.truth.matrix).sum(axis=1).max()
    assert np.abs(left).max() <= 6.0 * mission.sigma_nt + lost


# ---------------------------------------------------------------------------------------------------------- attitude


def test_nadir_points_down_and_along_the_orbit_within_its_wobble() -> None:
    flight, draws, t_s = flight_of(1), draws_of(1), np.arange(0.0, 6000.0, 60.0)
    q = MODES["nadir"](draws, flight, 6000.0)(t_s)
    r_km, v_km_s = flight.state_gcrf(t_s)
    down = rotate(q, -unit_rows(r_km))
    assert angle_deg(down, np.array([0.0, 0.0, 1.0])).max() <= draws.drawn["wobble_deg"]
    normal = rotate(q, unit_rows(np.cross(r_km, v_km_s)))
    assert angle_deg(normal, np.array([0.0, -1.0, 0.0])).max() <= draws.drawn["wobble_deg"]


def test_the_sun_is_along_the_third_axis_within_the_wobble() -> None:
    flight, t_s = flight_of(2), np.arange(0.0, 20000.0, 100.0)
    for seed in range(4):
        draws = draws_of(seed)
        seen = rotate(MODES["sun"](draws, flight, 20000.0)(t_s), unit_rows(flight.sun_gcrf_km(t_s)))
        assert angle_deg(seen, np.array([0.0, 0.0, 1.0])).max() <= draws.drawn["wobble_deg"]


@pytest.mark.parametrize(("mode", "figure"), [("spin", "spin_deg_s"), ("fast spin", "fast_spin_deg_s")])
def test_a_spin_turns_at_its_rate_about_one_axis(mode: str, figure: str) -> None:
    draws, t_s = draws_of(3), 3600.0 + np.arange(5) * 0.05
    q = MODES[mode](draws, flight_of(3), 3600.0)(t_s)
    turns = multiply(conjugate(q[:-1]), q[1:])
    np.testing.assert_allclose(np.rad2deg(rotation_angle(turns)) / 0.05, draws.drawn[figure], rtol=1e-6)
    axes = unit_rows(turns[:, 1:] * np.sign(turns[:, :1]))
    np.testing.assert_allclose(axes, np.tile(axes[0], (4, 1)), atol=1e-6)


def test_a_fast_spin_passes_half_a_turn_between_samples(drawn: dict[str, Mission]) -> None:
    mission = drawn["fast spin"]
    step_s = np.diff(mission.samples.t_utc).min() / np.timedelta64(1, "s")
    assert mission.drawn["fast_spin_deg_s"] * step_s > 180.0


@pytest.mark.parametrize("seed", range(3))
def test_a_nutating_spin_starts_off_an_extreme_axis_by_its_nutation(seed: int) -> None:
    """The rate from a turn over a millisecond; the axes are those of the smallest and the largest moment."""
    draws = draws_of(seed)
    q = MODES["nutating spin"](draws, flight_of(3), 3600.0)(np.array([0.0, 0.001]))
    rate = 2.0 * multiply(conjugate(q[0]), q[1])[1:] / 0.001
    off = angle_deg(np.tile(rate, (2, 1)), np.eye(3)[[0, 2]]).min()
    assert off == pytest.approx(draws.drawn["nutation_deg"], abs=0.05)
    assert np.rad2deg(np.linalg.norm(rate)) == pytest.approx(draws.drawn["spin_deg_s"], rel=1e-3)


def test_a_tumble_starts_at_its_rate() -> None:
    draws = draws_of(4)
    q = MODES["tumbling"](draws, flight_of(3), 3600.0)(np.array([0.0, 0.1]))
    turned_deg = np.rad2deg(rotation_angle(multiply(conjugate(q[0]), q[1])))
    assert turned_deg / 0.1 == pytest.approx(draws.drawn["tumble_deg_s"], rel=1e-3)


def test_b_dot_damps_the_rate_across_a_constant_field_alone() -> None:
    """A sphere: the rate along the field stays, that across it falls by exp(-k B^2 t / J)."""
    moment, damping, t_s = 0.04, 4e4, 1800
    body = MagneticBody(np.full(3, moment), damping, np.zeros(3), 0.0, 1.0)
    found = integrated(
        body, np.tile(FIELD_NT, (t_s + 1, 1)), np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.02, 0.01, 0.0])
    )
    along = FIELD_NT / np.linalg.norm(FIELD_NT)
    rates = rotate(conjugate(found.q), found.rate_rad_s)
    first, last = rates[0], rates[-1]
    assert last @ along == pytest.approx(first @ along, rel=1e-6)
    falls = np.exp(-damping * np.sum((1e-9 * FIELD_NT) ** 2) * t_s / moment)
    across = [np.linalg.norm(rate - (rate @ along) * along) for rate in (first, last)]
    assert across[1] / across[0] == pytest.approx(falls, rel=1e-4)
    assert falls < 0.9


def test_b_dot_leaves_a_slow_turn_that_follows_the_field() -> None:
    """What is left turns about as fast as the field does along the orbit: twice the orbit's 0.06 deg/s, at most 0.3."""
    flight, draws = flight_of(5), draws_of(5)
    t_s = np.arange(0.0, 43200.0, 10.0)
    q = MODES["B-dot"](draws, flight, 43200.0)(t_s)
    rate = np.rad2deg(rotation_angle(multiply(conjugate(q[:-1]), q[1:]))) / 10.0
    assert rate[-540:].mean() < 0.3
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-12)


def test_a_magnet_keeps_its_energy_and_rods_take_it() -> None:
    moments, magnet = np.array([0.04, 0.038, 0.028]), np.array([0.0, 0.0, 0.5])
    start, rate = unit(np.array([1.0, 0.3, -0.2, 0.1])), np.array([0.004, -0.003, 0.002])
    field_nt = np.tile(FIELD_NT, (7201, 1))

    def energy(rods: float) -> Floats:
        found = integrated(MagneticBody(moments, 0.0, magnet, rods, 1e-5), field_nt, start, rate)
        of_magnet = rotate(found.q, 1e-9 * field_nt) @ magnet
        return np.asarray(0.5 * found.rate_rad_s**2 @ moments - of_magnet)

    free, damped = energy(0.0), energy(0.05)
    depth = 0.5 * np.linalg.norm(1e-9 * FIELD_NT)
    np.testing.assert_allclose(free, free[0], atol=1e-5 * depth)
    # A smooth part of what rods store comes and goes with the swing: means of half an hour.
    assert damped[-1800:].mean() < damped[:1800].mean() - 0.01 * depth


def test_a_magnet_with_rods_stays_near_the_field() -> None:
    flight, draws = flight_of(6), draws_of(6)
    t_s = np.arange(0.0, 20000.0, 20.0)
    q = MODES["hysteresis rods"](draws, flight, 20000.0)(t_s)
    seen = unit_rows(rotate(q, flight.field_gcrf_nt(t_s)))
    assert np.median(angle_deg(seen, np.array([0.0, 0.0, 1.0]))) < 60.0


# ---------------------------------------------------------------------------------------------------- orbit and light


def test_a_transfer_orbit_has_the_apogee_and_the_perigee_that_were_drawn() -> None:
    """To 40 km: what SGP4's mean elements differ from osculating ones."""
    draws = draws_of(7)
    names = ("transfer_perigee_km", "transfer_apogee_km", "transfer_inclination_deg")
    orbit = draw_transfer_orbit(draws.random, START, {name: draws.of(name) for name in names})
    radius_km = np.linalg.norm(Flight(orbit, Igrf(), START).state_gcrf(np.arange(0.0, 40000.0, 5.0))[0], axis=1)
    assert radius_km.max() - 6378.1 == pytest.approx(draws.drawn["transfer_apogee_km"], abs=40.0)
    assert radius_km.min() - 6378.1 == pytest.approx(draws.drawn["transfer_perigee_km"], abs=40.0)


def test_light_is_that_of_a_cylinder_but_for_the_edge_of_the_shadow() -> None:
    flight, t_s = flight_of(8), np.arange(0.0, 20000.0, 5.0)
    light = flight.light(t_s)
    cylinder = light_of(flight.state_gcrf(t_s)[0], sun_gcrf(flight.t_utc(t_s)))
    assert 0.2 < np.mean(light == 0.0) < 0.45
    assert np.mean((light > 0.5) != (cylinder > 0.5)) < 0.01


# --------------------------------------------------------------------------------------------------- errors of the bias


def test_heat_comes_and_goes_with_its_two_time_constants() -> None:
    light = np.repeat([0.0, 1.0, 0.0], [400, 200, 200])
    y = followed(light, 20.0, 600.0, 1500.0)
    start = y[399]
    risen = 1.0 - (1.0 - start) * np.exp(-20.0 * 200 / 600.0)
    assert y[599] == pytest.approx(risen, rel=1e-12)
    assert y[799] == pytest.approx(risen * np.exp(-20.0 * 200 / 1500.0), rel=1e-12)


def test_panels_give_the_cosine_of_the_sun_up_to_their_limit_and_nothing_in_shadow() -> None:
    half = np.sqrt(0.5)
    sun = np.array([[half, half, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = panel_currents(np.array([1.0, 1.0, 1.0, 0.0]), sun, np.eye(3), 0.8)
    np.testing.assert_allclose(found, [[half, half, 0.0], [0.8, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


@pytest.mark.parametrize("seed", range(4))
def test_torquers_are_on_for_their_share_of_the_time(seed: int) -> None:
    """Seconds of an hour and a half; an edge of a period falls on a second at most once: 0.5 s of 5 s at the worst."""
    draws, flight, t_s = draws_of(seed), flight_of(seed), np.arange(0.0, 5400.0, 0.25)
    columns = torquer_columns(draws, flight, MODES["spin"](draws, flight, 5400.0), t_s)
    assert set(np.unique(columns)) <= {-1.0, 0.0, 1.0}
    is_on = t_s % draws.drawn["torquer_period_s"] < draws.drawn["torquer_duty"] * draws.drawn["torquer_period_s"]
    assert not columns[~is_on].any()
    assert np.mean(is_on) == pytest.approx(draws.drawn["torquer_duty"], abs=0.05)
    assert np.mean(columns[is_on] != 0.0) > 0.6


def test_a_walk_ends_with_the_spread_that_was_drawn() -> None:
    """1200 ends of unit spread: their standard deviation is within 10 % of 1 at more than four of its errors."""
    flight, t_s, ends = flight_of(0), np.arange(0.0, 3000.0, 30.0), []
    for seed in range(400):
        draws = draws_of(seed)
        ends.append(random_walk(draws, flight, lambda _t: np.zeros((0, 4)), t_s).moved_nt[-1] / draws.drawn["walk_nt"])
    assert np.std(ends) == pytest.approx(1.0, rel=0.1)


# ---------------------------------------------------------------------------------------------------------- electronics


def test_quantised_readings_are_multiples_of_the_step(drawn: dict[str, Mission]) -> None:
    steps = drawn["quantised"].samples.h_nt / drawn["quantised"].drawn["step_nt"]
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_clipped_readings_stand_at_the_limit_and_are_no_truth(drawn: dict[str, Mission]) -> None:
    mission = drawn["clipped"]
    limit_nt, share = mission.drawn["limit_nt"], mission.drawn["clipped_share"]
    assert np.abs(mission.samples.h_nt).max() == limit_nt
    at_limit = (np.abs(mission.samples.h_nt) == limit_nt).any(axis=1)
    assert not mission.is_sound[at_limit].any()
    assert at_limit.mean() == pytest.approx(share, abs=0.1)


def test_a_stuck_axis_keeps_its_value_while_the_others_move(drawn: dict[str, Mission]) -> None:
    whole = np.ptp(drawn["one axis stuck throughout"].samples.h_nt, axis=0)
    assert np.count_nonzero(whole == 0.0) == 1
    assert not drawn["one axis stuck throughout"].is_determined
    part = np.diff(drawn["one axis stuck for a stretch"].samples.h_nt, axis=0) == 0.0
    assert np.count_nonzero(part.any(axis=0)) == 1
    assert part.sum() / len(part) == pytest.approx(drawn["one axis stuck for a stretch"].drawn["stuck_share"], abs=0.1)


def test_a_mean_over_the_interval_shortens_what_lies_across_the_spin() -> None:
    """Of a spin by an angle a per interval the part across the axis shrinks by sin(a/2) / (a/2), the other stays."""
    flight, draws = flight_of(9), draws_of(9)
    motion, t_s = MODES["spin"](draws, flight, 600.0), np.array([300.0])
    interval_s = 90.0 / draws.drawn["spin_deg_s"]
    still = flight.field_gcrf_nt(t_s)[0]
    steady = replace(flight, field=ConstantField(still))
    turn = multiply(conjugate(motion(np.array([0.0]))), motion(np.array([0.1])))[0]
    axis = turn[1:] / np.linalg.norm(turn[1:])
    found = averaged_nt(steady, motion, t_s, interval_s, parts=400)[0]
    now = rotate(motion(t_s), steady.field_gcrf_nt(t_s))[0]
    along = (now @ axis) * axis
    half = np.deg2rad(45.0)
    np.testing.assert_allclose(found, along + np.sin(half) / half * (now - along), rtol=1e-4, atol=0.5)


class ConstantField:
    """A field that is the same in inertial axes at all times, to what the Earth turns in a second."""

    name = "constant"

    def __init__(self, b_gcrf_nt: Floats) -> None:
        self.b_gcrf_nt = b_gcrf_nt

    def field_itrf_nt(self, t_utc: np.ndarray, r_itrf_km: Floats) -> Floats:
        return gcrf_to_itrf(t_utc, np.tile(self.b_gcrf_nt, (len(r_itrf_km), 1)))


def test_the_straight_part_of_a_cubic_response_belongs_to_the_truth() -> None:
    """Over a sphere the straight line nearest to x^3 is 3/5 B^2 x: of 0.02 at 50 uT and |B| 40 uT it is 0.768 %."""
    mission = draw_kind("cubic response", 3)
    b_nt = 40000.0 * even_directions(2000)
    ideal = SensorModel(np.zeros(3), np.ones(3), np.zeros(3))
    bent = replace(
        mission,
        truth=ideal,
        b_base_nt=b_nt,
        moved_nt=np.zeros_like(b_nt),
        is_sound=np.ones(len(b_nt), dtype=bool),
        cubic_share=np.array([0.02, 0.0, 0.0]),
    )
    found = effective_truth(bent)
    np.testing.assert_allclose(found.scale, [1.0 + 0.6 * 0.02 * 0.8**2, 1.0, 1.0], atol=2e-5)
    np.testing.assert_allclose(found.bias_nt, 0.0, atol=1.0)


# --------------------------------------------------------------------------------------------------- when samples come


def test_passes_are_minutes_at_a_time_over_days(drawn: dict[str, Mission]) -> None:
    mission = drawn["passes over days"]
    t_h = (mission.samples.t_utc - mission.samples.t_utc[0]) / np.timedelta64(3600, "s")
    gaps = np.flatnonzero(np.diff(t_h) > 0.5)
    assert len(gaps) + 1 >= 4
    assert t_h[-1] > 24.0
    starts, ends = np.append(0, gaps + 1), np.append(gaps, len(t_h) - 1)
    assert np.all(t_h[ends] - t_h[starts] <= mission.drawn["pass_min"] / 60.0 + 1e-9)


def test_sparse_samples_are_dense_in_shadow_and_minutes_apart_in_the_sun(drawn: dict[str, Mission]) -> None:
    mission = drawn["sparse in the sun, heat"]
    assert mission.light is not None
    lit = mission.light > 0.5
    steps_s = np.diff(mission.samples.t_utc) / np.timedelta64(1, "s")
    within = ~lit[1:] & ~lit[:-1]
    assert np.median(steps_s[within]) == SHADOW_STEP_S
    assert np.median(steps_s[lit[1:] & lit[:-1]]) >= mission.drawn["sunlit_step_s"] - SHADOW_STEP_S
    assert 0.0 < lit.mean() < 0.25


# -------------------------------------------------------------------------------------------------------- the pipeline


@pytest.mark.parametrize("seed", range(3))
def test_a_sensor_with_a_dead_axis_is_never_accepted(seed: int) -> None:
    outcome = run_mission(draw_kind("one axis stuck throughout", seed))
    assert outcome.grade == "refuse"
    assert not outcome.is_good


def test_an_easy_mission_of_a_kind_is_calibrated_to_its_interval() -> None:
    outcome = run_mission(draw_kind("quantised", 0))
    assert outcome.grade == "accept"
    assert outcome.is_good
    assert outcome.is_covered is not None
    assert outcome.is_covered.sum() >= 7
    assert outcome.distance is not None
    assert outcome.distance < 30.0


def test_a_bent_response_counts_in_the_error_of_the_corrected_field() -> None:
    ideal = SensorModel(np.zeros(3), np.ones(3), np.zeros(3))
    exact = Parameters(np.zeros(3), np.ones(3), np.zeros(3))
    # Along the first axis at 40 uT: 0.05 times 0.8^2.
    assert largest_error_share(exact, ideal, np.array([0.05, 0.0, 0.0])) == pytest.approx(0.032, rel=0.03)
