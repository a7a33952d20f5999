"""Columns of operations files: what moves the bias is taken, at its lag, and what says nothing is not."""

from dataclasses import replace

import numpy as np

from magcal_core.pipeline import calibrate
from tests.magcal_core.decoys import draw


def taken(session):
    got = calibrate(session.flown.sent(), [session.flown.orbit], regressors="auto")
    return tuple(got.parameters.regressors), got


def test_a_torquer_one_sample_late_is_taken_where_the_reference_is_an_orbit():
    """The clock is looked for beside it at shifted times, at which the column keeps its lag."""
    names, got = taken(draw(0, "none", "torquer"))
    assert names == ("torquer@1",)
    assert got.verdict.grade != "refuse"


def test_a_lag_is_that_of_the_whole_session_where_rows_are_left_out():
    """A fifth of the rows is no reading: the clock's fit to the rest has the column one row before each, not others."""
    session = draw(3, "none", "torquer")
    samples = session.flown.samples
    h_nt = samples.h_nt.copy()
    h_nt[np.random.default_rng(3).choice(len(h_nt), len(h_nt) // 5, replace=False)] = 0.0
    sent = session.flown.sent(replace(samples, h_nt=h_nt))
    whole, holed = (
        calibrate(one, [session.flown.orbit], regressors=("torquer@1",), time_offset="estimate")
        for one in (session.flown.sent(), sent)
    )
    first, second = (np.array(got.parameters.regressors["torquer@1"]) for got in (whole, holed))
    assert np.all(np.abs(second - first) < 5 * np.array(whole.standard_errors.regressors["torquer@1"]) + 5.0)
    assert abs(holed.extras["time_offset"]["offset_s"]) < 0.5
