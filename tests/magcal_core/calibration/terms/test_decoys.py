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


def test_a_column_that_gains_and_is_not_taken_asks_for_another_session():
    """Unseen heat of the orbit: a housekeeping column of the same period predicts it on unseen blocks as well."""
    names, got = taken(draw(10, "heat", ""))
    assert not names
    told = [one for one in got.warnings if one.startswith("term_needs_another_session: orbital_")]
    assert len(told) == 1
    assert " lowers the residual on unseen blocks from " in told[0]
    rows = [row for row in got.extras["ablation"] if row["regressors"]]
    assert rows and not any(row["selected"] for row in rows)


def test_a_bias_that_remembers_for_minutes_is_no_evidence_of_a_switching_current():
    """100 nT with a memory of 15 min: slower terms alone leave it to whatever column steps at the right time."""
    names, got = taken(draw(400001, "memory", ""))
    assert not names
    assert all(row["log_evidence"] < 3.0 for row in got.extras["ablation"] if row["regressors"])


def test_no_column_is_taken_in_place_of_another_that_explains_more():
    """A wave beside a temperature that its surrogates refuse: another column of the orbit's period comes as near."""
    names, got = taken(draw(410002, "wave", "temperature"))
    assert set(names) <= {"temperature"}
    assert names or any(one.startswith("term_needs_another_session") for one in got.warnings)


def test_a_column_that_gains_nothing_asks_for_nothing():
    names, got = taken(draw(10, "none", ""))
    assert not names
    assert not [one for one in got.warnings if one.startswith("term_needs_another_session")]


def test_a_full_operations_table_ends_with_a_number_and_takes_none_of_its_columns():
    """Of 53 columns, the other magnetometer and the reference among them, none moves this sensor."""
    session = draw(21, "none", "", columns=47)
    flown = session.flown
    b_nt, rng = flown.samples.b_ref_base_nt, np.random.default_rng(21)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    other = 0.9 * b_nt @ turn.T + 4000.0 + 80.0 * rng.normal(size=b_nt.shape)
    more = {f"extmag_{i}": other[:, i] for i in range(3)} | {f"ephem_mag_{i}": b_nt[:, i] for i in range(3)}
    table = replace(flown.samples, housekeeping={**session.columns, **more})
    got = calibrate(flown.sent(table), [flown.orbit], regressors="auto")
    excluded = {one["name"]: one["excluded"] for one in got.extras["regressor_candidates"]}
    assert len(excluded) == 53
    assert all(excluded[name] in ("function_of_field", "reference_column") for name in more)
    assert not got.parameters.regressors
    assert got.verdict.grade in ("accept", "weak")
    # Noise of 60 nT as a sensor with gains of 0.9 shows it, and what nine parameters cost on unseen blocks.
    assert got.cross_validated_rms_nt < 1.1 * 60.0 / 0.9
