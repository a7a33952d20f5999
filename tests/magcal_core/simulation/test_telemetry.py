"""Simulated telemetry against its own truth: model, orbit, field and every disturbance, one at a time."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.attitude.rotation import attitude_matrix
from magcal_core.errors import OptionError
from magcal_core.field.igrf import Igrf
from magcal_core.orbit.earth.frames import itrf_to_gcrf
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import SampleFlag
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, Simulation, simulate
from magcal_core.telemetry import read_samples, write_samples

START = np.datetime64("2022-02-19T22:37:44.130")
DEKART = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])


@pytest.fixture(scope="module")
def orbit(data_dir: Path) -> Sgp4Orbit:
    return Sgp4Orbit(parse_tles((data_dir / "dekart.tle.txt").read_text())[0])


def simulated(
    orbit: Sgp4Orbit, disturbances: Disturbances | None = None, *, seed: int = 7, samples: int = 700
) -> Simulation:
    return simulate(orbit, DEKART, START, 10.0 * samples, 10.0, disturbances=disturbances, seed=seed)


def test_readings_are_the_sensor_model_of_the_field_on_the_orbit_turned_by_the_attitude_sent(orbit: Sgp4Orbit) -> None:
    """To 1e-6 nT: the same matrices in another order of products."""
    got = simulated(orbit).samples
    assert got.q_base_gcrf is not None
    r_itrf_km = orbit.position_itrf_km(got.t_utc)
    b_itrf_nt = Igrf(version=14, max_degree=13).field_itrf_nt(got.t_utc, r_itrf_km)
    b_gcrf_nt = itrf_to_gcrf(got.t_utc, b_itrf_nt)
    b_base_nt = np.einsum("nij,nj->ni", attitude_matrix(got.q_base_gcrf), b_gcrf_nt)
    h_nt = np.einsum("ij,nj->ni", DEKART.matrix, b_base_nt) + np.array([2928.125, -1191.25, -1875.625])
    np.testing.assert_allclose(got.h_nt, h_nt, atol=1e-6)


def test_samples_stand_at_the_instants_asked_for(orbit: Sgp4Orbit) -> None:
    got = simulate(orbit, DEKART, START, 3.0, 0.1)
    expected = START.astype("M8[ns]") + np.arange(30) * np.timedelta64(100, "ms")
    np.testing.assert_array_equal(got.samples.t_utc, expected)
    assert got.truth["samples"] == 30


def test_the_field_seen_by_the_sensor_turns_at_the_tumbling_rate(orbit: Sgp4Orbit) -> None:
    got = simulate(orbit, DEKART, START, 100.0, 1.0, rate_deg_s=0.76, seed=3)
    q = got.samples.q_base_gcrf
    assert q is not None
    turn_rad = 2.0 * np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), 0.0, 1.0))
    attitude = got.truth["attitude"]
    assert isinstance(attitude, dict)
    np.testing.assert_allclose(np.linalg.norm(attitude["rate_deg_s"]), 0.76, rtol=1e-12)
    # Over one second the rate of a nutating body changes by less than one per cent.
    np.testing.assert_allclose(np.rad2deg(turn_rad[0]), 0.76, rtol=0.01)


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(orbit: Sgp4Orbit) -> None:
    noisy = Disturbances(noise_nt=100.0, outlier_fraction=0.05, dropout_fraction=0.05)
    first, again, other = (simulated(orbit, noisy, seed=seed) for seed in (1, 1, 2))
    assert write_samples(first.samples, "csv") == write_samples(again.samples, "csv")
    assert json.dumps(first.truth) == json.dumps(again.truth)
    assert write_samples(first.samples, "csv") != write_samples(other.samples, "csv")


def test_one_disturbance_leaves_the_draws_of_the_others_alone(orbit: Sgp4Orbit) -> None:
    noisy = Disturbances(noise_nt=100.0)
    plain = simulated(orbit, noisy).samples
    spiked = simulated(orbit, replace(noisy, outlier_fraction=0.1, outlier_nt=5000.0))
    rows = spiked.truth["outlier_rows"]
    change = np.linalg.norm(spiked.samples.h_nt - plain.h_nt, axis=1)
    assert np.flatnonzero(change).tolist() == rows
    np.testing.assert_allclose(change[rows], 5000.0, rtol=1e-9)
    assert 40 <= len(rows) <= 100, "binomial(700, 0.1) lies within four standard deviations of 70"


def test_noise_has_the_size_asked_for(orbit: Sgp4Orbit) -> None:
    """2100 draws: the sample deviation is within 5 % of 100 nT at more than three of its standard errors."""
    noise = simulated(orbit, Disturbances(noise_nt=100.0)).samples.h_nt - simulated(orbit).samples.h_nt
    np.testing.assert_allclose(noise.std(), 100.0, rtol=0.05)
    assert abs(noise.mean()) < 3.0 * 100.0 / np.sqrt(2100)


def test_dropped_samples_are_missing_and_counted(orbit: Sgp4Orbit) -> None:
    got = simulated(orbit, Disturbances(dropout_fraction=0.2))
    whole = simulated(orbit)
    dropped = got.truth["dropped"]
    assert isinstance(dropped, int)
    assert len(got.samples) == 700 - dropped == got.truth["samples"] == len(got.b_base_nt)
    kept = np.isin(whole.samples.t_utc, got.samples.t_utc)
    np.testing.assert_array_equal(got.samples.h_nt, whole.samples.h_nt[kept])


def test_the_clock_is_behind_by_its_offset(orbit: Sgp4Orbit) -> None:
    got, true = simulated(orbit, Disturbances(time_offset_s=12.5)), simulated(orbit)
    np.testing.assert_array_equal(true.samples.t_utc - got.samples.t_utc, np.timedelta64(12_500_000_000, "ns"))
    np.testing.assert_array_equal(got.samples.h_nt, true.samples.h_nt)
    np.testing.assert_array_equal(got.t_true_utc, true.samples.t_utc)
    parameters = got.truth["parameters"]
    assert isinstance(parameters, dict)
    assert parameters["time_offset_s"] == 12.5


def test_readings_are_cut_at_the_range(orbit: Sgp4Orbit) -> None:
    got = simulated(orbit, Disturbances(range_nt=25_000.0))
    assert np.abs(got.samples.h_nt).max() == 25_000.0
    read = read_samples(write_samples(got.samples, "csv"), range_nt=25_000.0)
    assert np.flatnonzero(read.flags & SampleFlag.SATURATED).tolist() == got.truth["saturated_rows"]


def test_temperature_moves_the_bias_as_its_coefficients_say(orbit: Sgp4Orbit) -> None:
    coefficients = (10.0, -20.0, 5.0)
    got, plain = simulated(orbit, Disturbances(temperature_nt_per_k=coefficients)).samples, simulated(orbit).samples
    temperature_c = got.housekeeping["temperature"]
    np.testing.assert_allclose(got.h_nt - plain.h_nt, np.outer(temperature_c, coefficients), atol=1e-9)
    assert 5.0 <= temperature_c.min() < 10.0
    assert 30.0 < temperature_c.max() <= 35.0


def test_wave_and_drift_move_the_bias_with_no_column_to_tell(orbit: Sgp4Orbit) -> None:
    slow = Disturbances(wave_nt=(250.0, 0.0, 0.0), wave_period_s=2400.0, drift_nt_per_h=(0.0, 0.0, 36.0))
    change = simulated(orbit, slow).samples.h_nt - simulated(orbit).samples.h_nt
    np.testing.assert_allclose(change[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(change[:, 2], 0.1 * np.arange(700), atol=1e-9)
    # A sine is the opposite of itself half a period, 120 samples, later.
    np.testing.assert_allclose(change[120:, 0], -change[:-120, 0], atol=1e-8)
    np.testing.assert_allclose(np.abs(change[:, 0]).max(), 250.0, rtol=1e-3)


def test_an_attitude_error_turns_the_attitude_sent_and_not_the_readings(orbit: Sgp4Orbit) -> None:
    got, true = simulated(orbit, Disturbances(attitude_noise_deg=1.0)).samples, simulated(orbit).samples
    np.testing.assert_array_equal(got.h_nt, true.h_nt)
    assert got.q_base_gcrf is not None
    assert true.q_base_gcrf is not None
    error_rad = 2.0 * np.arccos(np.clip(np.abs(np.sum(got.q_base_gcrf * true.q_base_gcrf, axis=1)), 0.0, 1.0))
    # Three axes of 1 deg each: rms sqrt(3) deg; 700 draws are good to three per cent.
    np.testing.assert_allclose(np.sqrt(np.mean(np.rad2deg(error_rad) ** 2)), np.sqrt(3.0), rtol=0.1)


def test_what_is_written_is_what_a_satellite_sends(orbit: Sgp4Orbit) -> None:
    header = write_samples(simulated(orbit).samples, "csv").splitlines()[0]
    assert header == b"time,bx,by,bz,qw,qx,qy,qz"


def test_the_true_field_can_be_put_beside_the_samples(orbit: Sgp4Orbit) -> None:
    got = simulated(orbit)
    samples = got.samples_with_reference
    np.testing.assert_allclose(DEKART.correct(samples.h_nt), got.b_base_nt, atol=1e-8)
    assert samples.b_ref_magnitude_nt is not None
    np.testing.assert_allclose(samples.b_ref_magnitude_nt, np.linalg.norm(got.b_base_nt, axis=1), rtol=1e-14)


@pytest.mark.parametrize(
    "options",
    [
        {"noise_nt": -1.0},
        {"noise_nt": float("nan")},
        {"outlier_fraction": 1.0},
        {"dropout_fraction": -0.1},
        {"wave_period_s": 0.0},
        {"range_nt": -5.0},
    ],
)
def test_disturbances_that_cannot_be_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        Disturbances(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("duration_s", "step_s"), [(0.0, 1.0), (10.0, 0.0), (float("nan"), 1.0), (1e12, 1.0)])
def test_a_span_without_samples_or_with_too_many_is_refused(orbit: Sgp4Orbit, duration_s: float, step_s: float) -> None:
    with pytest.raises(OptionError):
        simulate(orbit, DEKART, START, duration_s, step_s)


def test_the_public_name_stays_a_function_whatever_was_imported_before() -> None:
    """A module of the same name would take its place in the package as soon as it is imported."""
    assert callable(mc.simulate)
    assert mc.simulate is simulate
