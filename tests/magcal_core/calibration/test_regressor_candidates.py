"""Which columns may enter, and what is made of them: lags, triples, responses."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.terms.regressor_candidates import expanded, triples
from magcal_core.pipeline import calibrate
from magcal_core.sensor.regressors import lag_of, lagged, response_of


@pytest.fixture(scope="module")
def table(mission):
    """Columns of all kinds beside a magnetometer, none of which moves it."""
    flown = mission(n=900, noise_nt=60.0, seed=12).samples
    rng, t = np.random.default_rng(8), np.arange(900)
    other = (
        flown.b_ref_base_nt @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T * 0.9 + 4000 + 80 * rng.normal(size=(900, 3))
    )
    quaternion = rng.normal(size=(900, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    columns = {
        **{f"mag2_{i}": other[:, i] for i in range(3)},
        **{f"model_{i}": flown.b_ref_base_nt[:, i] for i in range(3)},
        **{f"q{i}": quaternion[:, i] for i in range(4)},
        "onboard_b": flown.b_ref_magnitude_nt * 1.01 + rng.normal(size=900),
        "seq": t + 100.0,
        "mode": (t > 890).astype(float),
        "empty": np.where(t % 2, np.nan, 1.0),
        "temperature": 20 + 12 * np.sin(2 * np.pi * t / 570.0) + rng.normal(size=900),
        **{f"torque_{i}": rng.choice([-1.0, 0.0, 1.0], 900) for i in range(3)},
    }
    return replace(flown, housekeeping=columns)


def test_columns_of_field_time_and_attitude_are_left_out_with_the_reason(table):
    got = calibrate(table, regressors="auto")
    excluded = {one["name"]: one["excluded"] for one in got.extras["regressor_candidates"]}
    assert {excluded[f"mag2_{i}"] for i in range(3)} == {"function_of_field"}
    assert {excluded[f"model_{i}"] for i in range(3)} <= {"function_of_field", "reference_column"}
    assert {excluded[f"q{i}"] for i in range(4)} == {"quaternion"}
    assert excluded["onboard_b"] in ("function_of_field", "reference_column")
    assert (excluded["seq"], excluded["mode"]) == ("counter_or_time", "flag")
    assert excluded["empty"] == "incomplete_or_constant"
    assert [excluded[name] for name in ("temperature", "torque_0", "torque_1", "torque_2")] == [None] * 4
    assert not got.parameters.regressors
    assert got.verdict.grade == "accept"


def test_a_triple_one_sample_late_is_found_whole(table):
    effect = np.array([[900.0, -300.0, 100.0], [50.0, 700.0, -200.0], [-100.0, 250.0, 800.0]])
    torque = np.column_stack([table.housekeeping[f"torque_{i}"] for i in range(3)])
    late = np.vstack([torque[:1], torque[:-1]])
    got = calibrate(replace(table, h_nt=table.h_nt + late @ effect), regressors="auto")
    assert list(got.parameters.regressors) == ["torque_0@1", "torque_1@1", "torque_2@1"]
    for i in range(3):
        errors = got.standard_errors.regressors[f"torque_{i}@1"]
        assert np.all(np.abs(got.parameters.regressors[f"torque_{i}@1"] - effect[i]) < 5 * errors + 5)
    named = calibrate(replace(table, h_nt=table.h_nt + late @ effect), regressors=("torque_*@1",))
    assert list(named.parameters.regressors) == list(got.parameters.regressors)


def test_a_column_that_is_asked_for_is_taken_with_a_warning(table):
    got = calibrate(table, regressors=("seq",))
    assert list(got.parameters.regressors) == ["seq"]
    assert [one for one in got.warnings if one.startswith("counter_or_time: seq")]


def test_a_cubic_response_is_found_where_responses_are_asked_for(table):
    cubic = np.array([600.0, -500.0, 700.0])
    h = table.h_nt + (table.h_nt / 5e4) ** 3 * cubic
    bent = replace(table, h_nt=h, housekeeping={})
    got = calibrate(bent, regressors="auto", response="auto")
    assert "h^3" in got.parameters.regressors
    np.testing.assert_allclose(got.parameters.regressors["h^3"], cubic, atol=120)
    assert not calibrate(bent, regressors="auto").parameters.regressors


def test_eddy_currents_are_a_term_by_name(table):
    t_s = 10.0 * np.arange(900)
    delay_s = np.array([3.0, 2.0, 2.5])
    h = table.h_nt + response_of("dh/dt", table.h_nt, t_s) * delay_s
    got = calibrate(replace(table, h_nt=h), regressors=("dh/dt",))
    np.testing.assert_allclose(got.parameters.regressors["dh/dt"], delay_s, atol=0.5)


def test_lags_do_not_reach_across_gaps():
    t_s = np.array([0.0, 10.0, 20.0, 100.0, 110.0, 120.0, 130.0, 140.0])
    column = np.arange(8.0)
    np.testing.assert_array_equal(lagged(column, 1, t_s), [np.nan, 0, 1, np.nan, 3, 4, 5, 6])
    np.testing.assert_array_equal(lagged(column, -2, t_s), [2, np.nan, np.nan, 5, 6, 7, np.nan, np.nan])
    assert lag_of("torque_0@-2") == ("torque_0", -2)
    assert lag_of("name@home") == ("name@home", 0)


def test_groups_are_spelled_out():
    names = ["torque_0", "torque_1", "torque_2", "mtq_x", "mtq_y", "mtq_z", "t"]
    assert triples(names) == [("torque_0", "torque_1", "torque_2"), ("mtq_x", "mtq_y", "mtq_z")]
    assert expanded(("t", "mtq_*", "torque_*@1"), names) == (
        *("t", "mtq_x", "mtq_y", "mtq_z"),
        *("torque_0@1", "torque_1@1", "torque_2@1"),
    )
