"""The mean field of a sensor that averages: against scipy's rotations, finely sampled, and what is not known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magcal_core.reference.averaging import QUATERNIONS, Averaging, BodyRate, averaged_by_attitude
from magcal_core.samples import Samples
from magcal_core.simulation.tumbling import Tumbling

START = np.datetime64("2022-02-19T22:00:00", "ns")
RNG = np.random.default_rng(11)
N = 40


def times(step_s: float, n: int = N):
    return START + np.rint(np.arange(n) * step_s * 1e9).astype("timedelta64[ns]")


def scipy_mean(rate: np.ndarray, b_nt: np.ndarray, integration_s: float, points: int = 1000) -> np.ndarray:
    """The mean over midpoints of ``points`` parts of the interval: good to (w T)^2 / (24 points^2) of the field."""
    s = integration_s * ((np.arange(points) + 0.5) / points - 0.5)
    return Rotation.from_rotvec(-np.outer(s, rate)).apply(b_nt).mean(axis=0)


@pytest.mark.parametrize("integration_s", [0.01, 1.0, 8.0])
def test_a_steady_turn_is_the_finely_sampled_mean(integration_s):
    """A body turned by w s sees a fixed vector turned back by it; up to 480 deg in the interval."""
    rate, b_nt = np.deg2rad(RNG.uniform(-35.0, 35.0, (N, 3))), RNG.normal(0.0, 3e4, (N, 3))
    found = BodyRate(QUATERNIONS, rate, np.zeros((N, 3))).mean_of(b_nt, integration_s)
    expected = [scipy_mean(w, b, integration_s) for w, b in zip(rate, b_nt, strict=True)]
    np.testing.assert_allclose(found, expected, atol=0.2)


def test_along_the_axis_all_is_kept_and_across_it_the_sinc():
    """Half a turn in the interval leaves 2 / pi of what lies across, a whole one nothing."""
    b_nt = np.array([[3e4, 0.0, 2e4], [3e4, 0.0, 2e4]])
    rate = np.array([[0.0, 0.0, np.pi], [0.0, 0.0, 2.0 * np.pi]])
    found = BodyRate(QUATERNIONS, rate, np.zeros((2, 3))).mean_of(b_nt, 1.0)
    np.testing.assert_allclose(found, [[3e4 * 2.0 / np.pi, 0.0, 2e4], [0.0, 0.0, 2e4]], atol=1e-8)


def test_attitudes_of_a_free_body_give_the_mean_of_its_field():
    """Three unequal moments, 20 deg/s, one second: 140 nT are averaged away, half of them by the change of the rate.

    What is left are third differences of the motion, some 2 nT.
    """
    body = Tumbling(np.array([0.097, 0.078, 0.031]), np.deg2rad([14.0, -9.0, 11.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    b_gcrf = np.array([21000.0, -17000.0, 30000.0])
    q, _ = body.motion(np.arange(N, dtype=float))
    fine = np.arange(N)[:, None] + ((np.arange(1000) + 0.5) / 1000 - 0.5)
    turns, _ = body.motion(fine.ravel())
    seen = Rotation.from_quat(turns, scalar_first=True).inv().apply(b_gcrf).reshape(N, 1000, 3)
    instant = Rotation.from_quat(q, scalar_first=True).inv().apply(b_gcrf)
    samples = Samples(times(1.0), instant, q, b_ref_base_nt=instant, b_ref_magnitude_nt=np.linalg.norm(instant, axis=1))
    averaged, averaging = averaged_by_attitude(samples, 1.0)
    inner = slice(1, -1)
    before = np.abs(instant - seen.mean(axis=1))[inner].max()
    after = np.abs(averaged.b_ref_base_nt - seen.mean(axis=1))[inner].max()
    assert before > 100.0
    assert after < 5.0
    assert averaging.is_known.all()
    np.testing.assert_allclose(averaged.b_ref_magnitude_nt, np.linalg.norm(averaged.b_ref_base_nt, axis=1), rtol=1e-15)
    # The ends have one neighbour each: the rate is that of half a step aside.
    assert np.abs(averaged.b_ref_base_nt - seen.mean(axis=1)).max() < 0.6 * before


def spinning(step_s: float, rate_deg_s: float) -> np.ndarray:
    turns = Rotation.from_rotvec(np.outer(np.arange(N) * step_s, np.deg2rad([0.0, rate_deg_s, 0.0])))
    return turns.as_quat(scalar_first=True)


@pytest.mark.parametrize(("step_s", "rate_deg_s"), [(10.5, 1.0), (1.0, 95.0)])
def test_attitudes_too_far_apart_tell_no_rate_and_nothing_changes(step_s, rate_deg_s):
    b_nt = np.full((N, 3), 2e4)
    samples = Samples(
        times(step_s), b_nt, spinning(step_s, rate_deg_s), b_ref_base_nt=b_nt, b_ref_magnitude_nt=b_nt[:, 0]
    )
    averaged, averaging = averaged_by_attitude(samples, 1.0)
    assert not averaging.is_known.any()
    np.testing.assert_array_equal(averaged.b_ref_base_nt, b_nt)
    np.testing.assert_array_equal(averaged.b_ref_magnitude_nt, b_nt[:, 0])


def test_missing_and_doubled_attitudes_and_signs_of_quaternions_are_no_harm():
    """A row without attitude has no rate; its neighbours have theirs by the row beyond it."""
    q, t_utc = spinning(1.0, 12.0), times(1.0)
    q[::3] *= -1.0
    q[7] = np.nan
    t_utc[20] = t_utc[19]
    q[20] = q[19]
    rate = BodyRate.of_attitude(t_utc, q)
    known = np.delete(np.arange(N), 7)
    assert not rate.is_known[7]
    np.testing.assert_allclose(rate.rate_rad_s[known], np.tile(np.deg2rad([0.0, 12.0, 0.0]), (N - 1, 1)), atol=1e-12)
    assert not BodyRate.of_attitude(t_utc, None).is_known.any()


def test_readings_tell_the_direction_where_there_is_no_attitude():
    """|<B>| by the axis and the averaged readings is that of the components, exactly."""
    rate, b_nt = np.deg2rad(RNG.uniform(-35.0, 35.0, (N, 3))), RNG.normal(0.0, 3e4, (N, 3))
    turning = BodyRate("gyros", rate, np.zeros((N, 3)))
    mean_nt, size = turning.mean_of(b_nt, 2.0), np.linalg.norm(b_nt, axis=1)
    found = Averaging.of_readings(2.0, turning, mean_nt, size)
    np.testing.assert_allclose(found.share * size, np.linalg.norm(mean_nt, axis=1), rtol=1e-12)


@pytest.mark.parametrize("integration_s", [None, 0.0])
def test_without_an_integration_time_the_samples_are_the_same_object(integration_s):
    samples = Samples(times(1.0), np.ones((N, 3)), spinning(1.0, 12.0), b_ref_base_nt=np.ones((N, 3)))
    same, averaging = averaged_by_attitude(samples, integration_s)
    assert same is samples
    assert averaging is None


def test_a_magnitude_without_direction_stays_as_it_was_sent():
    size = np.full(N, 4e4)
    samples = Samples(times(1.0), np.ones((N, 3)), spinning(1.0, 12.0), b_ref_magnitude_nt=size)
    averaged, averaging = averaged_by_attitude(samples, 1.0)
    assert averaging.rate.is_known.all()
    assert not averaging.is_known.any()
    np.testing.assert_array_equal(averaged.b_ref_magnitude_nt, size)
