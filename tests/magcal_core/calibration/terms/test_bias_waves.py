"""Slow waves of the bias are seen where they are, and do not pass for an offset of the clock."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.terms.bias_waves import slow_waves, wave_columns
from magcal_core.calibration.terms.clock import fit_with_clock
from magcal_core.observations import Observations

N = 1800
PERIOD_S = 5640.0
NOISE_NT = 60.0


def waved(mission, amplitude_nt, seed, n=N):
    """A mission of ``n`` samples at 10 s whose bias swings along one axis with a random phase."""
    o = Observations.of(mission(n=n, noise_nt=NOISE_NT, seed=seed).samples)
    random = np.random.default_rng([seed, 5])
    wave = amplitude_nt * np.sin(2 * np.pi * o.t_s / PERIOD_S + random.uniform(0, 2 * np.pi))
    return replace(o, h_nt=np.ascontiguousarray(o.h_nt + np.outer(wave, np.eye(3)[seed % 3])))


def periods_of(o, method):
    return slow_waves(o, ESTIMATORS[method].fit(o, FitSettings()))


@pytest.mark.parametrize("method", ["scalar", "vector"])
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_wave_is_found_at_its_period(mission, method, seed):
    """Frequencies are sought an eighth of a wave a session apart: within that, 3.2 waves are 4 %."""
    periods = periods_of(waved(mission, 150.0, seed), method)
    assert len(periods) >= 1
    assert abs(N * 10.0 / periods[0] - N * 10.0 / PERIOD_S) <= 0.25


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_white_noise_shows_none(mission, method):
    """One session in a thousand may: two of thirty are a chance of 4e-4."""
    shown = [seed for seed in range(30) if periods_of(waved(mission, 0.0, seed, n=700), method)]
    assert len(shown) <= 1


def test_a_memory_without_a_period_is_left_to_the_honest_errors(mission):
    """A bias that remembers five minutes: no few waves explain it, and none are taken."""
    o = waved(mission, 0.0, 7)
    random, share = np.random.default_rng(3), np.exp(-10.0 / 300.0)
    walk = np.zeros((N, 3))
    for i in range(1, N):
        walk[i] = share * walk[i - 1] + np.sqrt(1 - share**2) * 150.0 * random.normal(size=3)
    assert periods_of(replace(o, h_nt=np.ascontiguousarray(o.h_nt + walk)), "scalar") == ()


def test_a_session_that_is_too_short_for_a_wave_has_none(mission):
    assert periods_of(waved(mission, 300.0, 1, n=60), "scalar") == ()


def test_the_mean_of_a_wave_is_not_taken_from_the_bias():
    t_s = np.arange(800) * 10.0
    for column in wave_columns(t_s, (PERIOD_S, 2400.0)).values():
        assert abs(column.mean()) < 1e-12


def sent(mission, offset_s, seed, method, amplitude_nt=150.0):
    """Return the reference by the clock of a mission whose clock is off, and its times."""
    o = waved(mission, amplitude_nt, seed)
    turn = o.require_vector() / o.b_nt[:, None]

    def size(t_s):
        return 35_000.0 + 9000.0 * np.sin(2 * np.pi * t_s / 2850.0) + 3000.0 * np.sin(2 * np.pi * t_s / 5700.0)

    sensor = mission(n=N, noise_nt=NOISE_NT, seed=seed).sensor
    errors_nt = o.h_nt - sensor.apply(o.require_vector())
    made = sensor.apply(turn * size(o.t_s + offset_s)[:, None]) + errors_nt
    fixed = replace(o, h_nt=np.ascontiguousarray(made), b_base_nt=None if method == "scalar" else o.b_base_nt)

    def at(shift_s, rows=slice(None)):
        few = fixed.take(rows)
        b_nt = size(few.t_s + shift_s)
        return replace(few, b_nt=b_nt, b_base_nt=None if method == "scalar" else turn[rows] * b_nt[:, None])

    return at, o.t_s


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_the_clock_is_found_beside_a_wave_as_well_as_without_it(mission, method):
    """Over 20 passes with an offset of 0.4 s: the errors are those of passes without a wave, and they are honest.

    The sum of 20 squared scores lies within 7.4 and 40 (99 % and more); the wave's six unknowns, which are not known
    beforehand, widen the error by a quarter at most, where as an error with a memory it would widen it threefold.
    """
    scores, with_wave, without = [], [], []
    for seed in range(20):
        at, t_s = sent(mission, 0.4, seed, method)
        got = fit_with_clock(ESTIMATORS[method], at, at(np.zeros(len(t_s))), FitSettings(), has_drift=False)
        assert got.wave_periods_s
        scores.append((got.offset_s - 0.4) / got.offset_error_s)
        with_wave.append(got.offset_error_s)
        at, t_s = sent(mission, 0.4, seed, method, amplitude_nt=0.0)
        still = fit_with_clock(ESTIMATORS[method], at, at(np.zeros(len(t_s))), FitSettings(), has_drift=False)
        assert not still.wave_periods_s
        without.append(still.offset_error_s)
    assert 7.4 < float(np.sum(np.square(scores))) < 40.0
    assert np.median(with_wave) < 1.25 * np.median(without)


def test_the_parameters_are_those_of_the_plain_fit_at_the_clock_that_was_found(mission):
    """And their covariance moves with the clock's as fits at a known clock do, by differences of two of them."""
    at, t_s = sent(mission, 3.0, 2, "scalar")
    got = fit_with_clock(ESTIMATORS["scalar"], at, at(np.zeros(len(t_s))), FitSettings(), has_drift=True)
    middle = t_s - 0.5 * (t_s[0] + t_s[-1])
    clock = got.offset_s + got.drift_s_per_day / 86400.0 * middle
    plain = ESTIMATORS["scalar"].fit(at(clock), FitSettings()).parameters.vector
    np.testing.assert_allclose(got.fit.parameters.vector[:9], plain, rtol=1e-9)
    later, sooner = (ESTIMATORS["scalar"].fit(at(clock + by), FitSettings()).parameters.vector for by in (0.05, -0.05))
    drifted = (
        ESTIMATORS["scalar"].fit(at(clock + sign * 1e-5 * middle), FitSettings()).parameters.vector for sign in (1, -1)
    )
    more, less = drifted
    moves = np.column_stack([(later - sooner) / 0.1, (more - less) / 2e-5])
    variance = got.honest.covariance[9:, 9:]
    np.testing.assert_allclose(got.honest.covariance[:9, 9:], moves @ variance, rtol=1e-3)
    assert got.honest.covariance[9, 9] == pytest.approx(got.offset_error_s**2)
    assert (
        np.linalg.eigvalsh(got.honest.covariance / np.outer(*2 * [np.sqrt(np.diag(got.honest.covariance))]))[0] > -1e-12
    )
