"""Rows that cannot be readings: flagged by kind, never edited, and no good row with them."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.samples import SampleFlag, Samples
from magcal_core.telemetry.screen import FILL_VALUES, at_a_limit, fill_flags, repeated, screened, stuck, unscreened


def session(h):
    t_utc = np.datetime64("2022-02-19T22:37:44", "ns") + np.arange(len(h)) * np.timedelta64(10, "s")
    return Samples(t_utc, np.asarray(h, dtype=np.float64))


def tumbling(n=700, step_nt=0.1, seed=0, rate=0.13):
    """Readings of a sensor that turns about two axes, in steps of ``step_nt``."""
    rng = np.random.default_rng(seed)
    turn = rate * np.arange(n)
    u = np.c_[np.cos(turn) * np.cos(0.41 * turn), np.sin(turn), np.cos(turn) * np.sin(0.41 * turn)]
    return np.round((35000 * u + rng.uniform(-9000, 9000, 3) + 60 * rng.normal(size=(n, 3))) / step_nt) * step_nt


def rows_with(samples, flag):
    return np.flatnonzero(samples.flags & np.uint16(flag)).tolist()


def test_each_kind_has_its_flag_and_no_good_row_with_it():
    h = tumbling()
    h[[3, 300]] = 0.0
    h[[40, 50, 60], 1] = -999.0
    h[100:140] = h[100]
    again = [150, 171, 200, 222, 290, 333, 411, 444, 500, 600, 633, 690]
    h[again] = (123.4, -5.6, 7.8)
    got = screened(session(h))
    assert rows_with(got, SampleFlag.ZERO) == [3, 300]
    assert rows_with(got, SampleFlag.FILL_VALUE) == [40, 50, 60]
    assert rows_with(got, SampleFlag.STUCK) == list(range(100, 140))
    assert rows_with(got, SampleFlag.REPEATED) == again
    assert got.is_used.sum() == 700 - 2 - 3 - 40 - 12
    assert got.h_nt is not None
    np.testing.assert_array_equal(got.h_nt, h)


@pytest.mark.parametrize("step_nt", [0.1, 10.0, 100.0, 300.0])
@pytest.mark.parametrize("rate", [0.13, 0.01])
def test_clean_readings_of_fine_and_coarse_sensors_keep_all_their_rows(step_nt, rate):
    """Coarse and slow: readings repeat, and dwell at their turning points."""
    for seed in range(5):
        got = screened(session(tumbling(step_nt=step_nt, rate=rate, seed=seed)))
        assert got.is_used.mean() >= 0.99, np.unique(got.flags)


@pytest.mark.parametrize("value", FILL_VALUES.tolist())
def test_every_fill_value_is_found_in_any_axis_and_in_single_precision(value):
    h = tumbling(seed=4)
    rows = np.random.default_rng(1).choice(700, 70, replace=False)
    h[rows, 2] = value
    h[rows[:9], 2] = np.float32(value)
    away = np.abs(value) > np.abs(tumbling(seed=4)).max()
    got = fill_flags(h, np.ones(700, dtype=bool)) != 0
    if away:
        assert np.flatnonzero(got).tolist() == sorted(rows)
    else:
        assert got[rows].all() == got[rows].any(), "a value is foreign or it is not"


def test_a_reading_of_32767_among_neighbours_of_32_microtesla_stays():
    h = np.c_[32000 + 40.0 * np.arange(60), np.sin(np.arange(60)), np.cos(np.arange(60))]
    h[19, 0] = 32767.0
    assert screened(session(h)).is_used.all()


def test_a_held_reading_is_not_stuck():
    """A table at ten times the sensor's own rate holds each reading for ten rows."""
    assert not stuck(np.repeat(tumbling(200), 10, axis=0)).any()
    held = np.repeat(tumbling(200), 10, axis=0)
    held[500:800] = held[500]
    assert np.flatnonzero(stuck(held)).tolist() == list(range(500, 800))


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("both", [False, True])
def test_rows_at_a_limit_are_saturated(share, both):
    h = tumbling(seed=2)
    limit = round(float(np.quantile(h[:, 1], 1 - share)), 1)
    h[:, 1] = np.clip(h[:, 1], -limit if both else -np.inf, limit)
    is_cut = (h[:, 1] == limit) | (both & (h[:, 1] == -limit))
    np.testing.assert_array_equal(at_a_limit(h), is_cut)


def test_repeated_triples_are_counted_exactly():
    """Against counts of whole rows."""
    rng = np.random.default_rng(3)
    h = rng.integers(0, 12, (3000, 3)).astype(float)
    h[rng.choice(3000, 200, replace=False)] = (3.0, 4.0, 5.0)
    _, inverse, counts = np.unique(h, axis=0, return_inverse=True, return_counts=True)
    want = counts[inverse.ravel()] >= max(3, 10 * np.median(counts))
    assert want.sum() >= 200
    np.testing.assert_array_equal(repeated(h), want)


def test_rows_that_are_out_already_say_nothing_of_the_others():
    h = tumbling()
    h[10:13] = np.nan
    samples = replace(session(h), flags=np.where(np.isnan(h[:, 0]), 1, 0).astype(np.uint16))
    assert screened(samples).is_used.sum() == 697


def test_the_plain_fit_has_the_rows_that_it_has_always_had():
    h = tumbling()
    h[7], h[9] = 65535.0, -9999.0
    flagged = replace(session(h), flags=fill_flags(h, np.ones(700, dtype=bool)))
    assert rows_with(flagged, SampleFlag.FILL_VALUE) == [7, 9]
    assert rows_with(unscreened(flagged), SampleFlag.FILL_VALUE) == [9]
