"""Variances from the lowest frequencies: right for white scores, and where a memory is as long as blocks of them."""

import numpy as np
import pytest

from magcal_core.calibration.uncertainty.low_frequencies import longest_memory_s, low_frequency_variances
from magcal_core.numerics.blocks import BlockScores

SESSION_S = 6 * 3600.0
"""Length of the sessions, s: memories from half a percent of it to as long as it is are tried."""


def mean_of(series: np.ndarray) -> BlockScores:
    """The scores of the mean of ``series``, shape (m, n): one unknown, m blocks of n samples of unit weight."""
    residuals = series - series.mean()
    m, n = series.shape
    scores, normals = residuals.sum(axis=1)[:, None], np.full((m, 1, 1), float(n))
    return BlockScores(scores, normals, np.arange(m, dtype=np.intp) * n, np.eye(1))


def remembering(random: np.random.Generator, count: int, memory: float) -> np.ndarray:
    """A first-order process of unit variance whose correlation falls to 1/e within ``memory`` samples."""
    share, values = np.exp(-1.0 / memory), random.normal(size=count)
    for i in range(1, count):
        values[i] = share * values[i - 1] + np.sqrt(1 - share**2) * values[i]
    return values


def test_white_scores_give_the_variance_of_a_mean():
    """400 means of 1000 values: the variance is 1/1000; in the median, what a session may hide adds at most 30 %."""
    random = np.random.default_rng(1)
    found = [low_frequency_variances(mean_of(random.normal(size=(50, 20))), SESSION_S)[0][0] for _ in range(400)]
    assert 0.9 < np.median(found) * 1000 < 1.3


@pytest.mark.parametrize(("memory", "least"), [(0.02, 0.92), (0.1, 0.95), (0.3, 0.87), (0.6, 0.70)])
def test_intervals_hold_under_a_long_memory(memory, least):
    """300 means of a process that remembers 2 to 60 % of the session; ten blocks and Student's t hold 52 % at 30.

    Two or three memories a session cannot tell more: the limit is what was measured less three binomial errors.
    """
    random, inside, by_blocks = np.random.default_rng(2), [], []
    for _ in range(300):
        series = remembering(random, 600, 600 * memory).reshape(60, 10) + 0.3 * random.normal(size=(60, 10))
        variance = low_frequency_variances(mean_of(series), SESSION_S)[0][0]
        inside.append(abs(series.mean()) < 1.96 * np.sqrt(variance))
        means = series.reshape(10, 60).mean(axis=1)
        by_blocks.append(abs(series.mean()) < 2.262 * means.std(ddof=1) / np.sqrt(10))
    assert np.mean(inside) >= least
    assert np.mean(inside) >= np.mean(by_blocks)


def test_what_the_fit_takes_up_is_allowed_for():
    """A tenth of the samples determines the unknown, and so leaves little residual there: wide by chance, never narrow.

    The true variance is that of white noise; four blocks of forty carry it, so that up to four times as much is said.
    In the median it is the true one to within 10 % (two errors of a median of 300); a quarter less is said where what
    the fit took up is not allowed for.
    """
    random, found = np.random.default_rng(3), []
    for _ in range(300):
        x = np.r_[np.ones(20), np.full(180, 0.05)]
        noise = random.normal(size=200)
        residual = noise - x * (x @ noise) / (x @ x)
        blocks = (x * residual).reshape(40, 5).sum(axis=1)[:, None], (x**2).reshape(40, 5).sum(axis=1)[:, None, None]
        found.append(low_frequency_variances(BlockScores(*blocks, np.arange(0, 200, 5), np.eye(1)), SESSION_S)[0][0])
    assert 0.8 < np.mean(found) * (x @ x) < 4.0
    assert 0.9 < np.median(found) * (x @ x) < 1.3


@pytest.mark.parametrize(("hours", "longest_h"), [(0.1, 0.6), (0.8, 16000 / 3600), (2.0, 16000 / 3600), (17.6, 17.6)])
def test_memories_are_hours_whatever_the_session(hours, longest_h):
    """Six sessions, but not more than 4.4 h; the session itself where that is longer."""
    assert longest_memory_s(hours * 3600.0) == pytest.approx(longest_h * 3600.0)


def test_the_same_scores_hide_more_in_a_short_session():
    """40 white series: what remembers hours shows in a day of data, and could not have shown in half an hour."""
    random = np.random.default_rng(4)
    series = [mean_of(random.normal(size=(50, 20))) for _ in range(40)]
    short, long = ([low_frequency_variances(one, s)[0][0] for one in series] for s in (1800.0, 86400.0))
    assert np.median(short) > 1.05 * np.median(long)
