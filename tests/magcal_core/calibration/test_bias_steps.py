"""Steps and path of the bias inside a session: worked cases, simulated sessions, dense algebra beside the banded."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.bias_in_session import _weakened, steps_of_session
from magcal_core.calibration.observability.information import WEAK_BELOW
from magcal_core.calibration.reasons import Reason, Verdict
from magcal_core.calibration.refit.moments import FitMoments
from magcal_core.calibration.result import Calibration
from magcal_core.calibration.sessions.monitoring import ActiveSet
from magcal_core.calibration.terms import wandering_bias as wb
from magcal_core.errors import OptionError
from magcal_core.sensor.regressors import step_column
from magcal_core.sessions import monitor
from tests.magcal_core.calibration.moving_bias import SENSOR, memory_nt, session, step_nt, time_of

CASES = ["session-1-step", "session-2-step", "session-3-wander"]
CHANGE = (350.0, -250.0, 200.0)


@pytest.fixture(scope="module")
def cases(data_dir) -> dict[str, tuple[dict, mc.Samples, Calibration]]:
    """Every worked case with its samples and its calibration."""
    found = {}
    for name in CASES:
        case = json.loads((data_dir / "time" / f"{name}.json").read_text(encoding="utf-8"))
        samples = mc.read_samples(data_dir / "time" / f"{name}.csv")
        found[name] = case, samples, mc.calibrate(samples, method=case["method"], with_moments=True)
    return found


def moments_of(samples: mc.Samples, method: str = "scalar", **options: object) -> FitMoments:
    found = mc.calibrate(samples, method=method, bias_steps="none", with_moments=True, **options).moments
    assert found is not None
    return found


@pytest.mark.parametrize("name", CASES)
def test_a_worked_case_names_the_steps_that_there_are(cases, name):
    """Time within a fortieth of the session and 60 s, size within 4.5 errors, no error above 120 nT."""
    case, samples, calibration = cases[name]
    found = calibration.to_dict()["bias_steps"]
    assert found["state"] == "searched"
    assert len(found["items"]) == len(case["answer"]["steps"])
    reach = (samples.t_utc[-1] - samples.t_utc[0]) / 40 + np.timedelta64(60, "s")
    for one, truth, answer in zip(found["items"], case["truth"]["steps"], case["answer"]["steps"], strict=True):
        away = np.datetime64(one["time"].rstrip("Z"), "ns") - np.datetime64(truth["time"].rstrip("Z"), "ns")
        assert abs(away) < reach
        errors = np.array(one["standard_errors_nt"])
        assert np.all(np.abs(np.array(one["change_nt"]) - truth["change_nt"]) < 4.5 * errors)
        assert errors.max() < 120.0
        assert one["statistic"] == pytest.approx(answer["statistic"], rel=0.02)
        np.testing.assert_allclose(one["standard_errors_nt"], answer["standard_errors_nt"], rtol=0.1)
    assert found["statistic"] == pytest.approx(case["answer"]["statistic_of_next"], rel=0.05)


@pytest.mark.parametrize(("seed", "noise_nt"), [(2, 15.0), (3, 30.0), (4, 15.0), (6, 30.0)])
def test_one_step_within_a_block_of_quiet_readings_is_one_step(seed, noise_nt):
    """The mean of the block in which it happened looks like a step of its own, a few blocks away."""
    share = 0.3 + 0.05 * seed
    moved = step_nt(session(seed), share, (370.0, -265.0, 210.0))
    (found,) = mc.bias_steps(moments_of(session(seed, moved, noise_nt=noise_nt))).items
    assert abs(found.time - time_of(session(seed), share)) < np.timedelta64(200, "s")
    assert np.all(np.abs(found.change_nt - (370.0, -265.0, 210.0)) < 4.5 * found.standard_errors_nt)


def test_two_steps_of_quiet_readings_are_two():
    moved = step_nt(session(4), 0.33, (200.0, -140.0, 90.0)) + step_nt(session(4), 0.61, (-150.0, 160.0, 120.0))
    found = mc.bias_steps(moments_of(session(4, moved, noise_nt=15.0))).items
    assert len(found) == 2
    for one, share in zip(found, (0.33, 0.61), strict=True):
        assert abs(one.time - time_of(session(4), share)) < np.timedelta64(200, "s")


def test_a_step_weakens_the_verdict_and_its_fit_has_the_bias_after_it(cases):
    case, samples, named = cases["session-1-step"]
    assert named.verdict.grade == "weak"
    # One bias for both sides is known to 2.4 % of the field, which alone makes the verdict weak.
    assert [reason.code for reason in named.verdict.reasons] == ["field_uncertain", "bias_step"]
    assert named.verdict.grades == ("weak", "weak")
    fitted = mc.calibrate(samples, method="scalar", bias_steps="fit")
    record = fitted.to_dict()
    assert record["bias_steps"]["is_fitted"]
    assert [reason.code for reason in fitted.verdict.reasons] == ["observable"]
    away = fitted.parameters.bias_nt - case["truth"]["bias_nt_after_last_step"]
    assert np.all(np.abs(away) < 3.0 * fitted.standard_errors.bias_nt)
    assert fitted.standard_errors.bias_nt.max() < 0.5 * named.standard_errors.bias_nt.max()
    (column,) = fitted.parameters.regressors
    assert column == f"before:{record['bias_steps']['items'][0]['time']}"
    before = fitted.parameters.regressors[column]
    np.testing.assert_allclose(-before, case["truth"]["steps"][0]["change_nt"], atol=120.0)
    assert fitted.after.rms_nt < 0.7 * named.after.rms_nt
    assert record["statistics"]["rejected"] == 16
    assert record["provenance"]["options"]["bias_steps"] == "fit"
    assert fitted.residuals.t_utc.shape == named.residuals.t_utc.shape


@pytest.mark.parametrize("grade", ["weak", "refuse"])
def test_a_verdict_with_reasons_of_its_own_says_the_grade_of_each_step_too(cases, grade):
    _, _, named = cases["session-1-step"]
    other = Verdict(grade, (Reason("large_residual", "400 nT"),), (grade,))
    found = _weakened(other, mc.bias_steps(named.moments))
    assert found.grade == grade
    assert [reason.code for reason in found.reasons] == ["large_residual", "bias_step"]
    assert found.grades == (grade, "weak")


def test_without_the_search_the_fit_is_bit_for_bit_the_same_and_the_record_has_no_word_of_it(cases):
    _, samples, named = cases["session-1-step"]
    plain = mc.calibrate(samples, method="scalar", bias_steps="none")
    assert "bias_steps" not in plain.to_dict()
    np.testing.assert_array_equal(plain.parameters.vector, named.parameters.vector)
    np.testing.assert_array_equal(plain.covariance, named.covariance)


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_sessions_without_a_step_have_none(method):
    """Of 896 sessions of this kind one was above the limit; eight of eight are below it but once in a hundred runs."""
    for seed in range(2):
        plain = session(300 + seed)
        hours = np.arange(len(plain))[:, None] / 240.0
        moves = {
            "white": np.zeros((len(plain), 3)),
            "memory": memory_nt(seed, plain, 100.0, 2700.0),
            "wave": 250.0 * np.sin(2.0 * np.pi * hours * 1.5) * [1.0, -0.5, 0.7],
            "drift": 200.0 * hours * [0.5, 0.5, -0.5],
        }
        for name, moved in moves.items():
            assert mc.bias_steps(moments_of(session(300 + seed, moved), method)).items == (), name


@pytest.mark.parametrize("method", ["scalar", "vector"])
@pytest.mark.parametrize("share", [0.3, 0.62])
def test_a_step_of_500_nt_is_named_beside_noise_and_memory(method, share):
    plain = session(410)
    for moved in (0.0, memory_nt(5, plain, 60.0, 600.0)):
        moments = moments_of(session(410, step_nt(plain, share, (350.0, -250.0, 250.0)) + moved), method)
        (one,) = mc.bias_steps(moments).items
        assert abs(one.time - time_of(plain, share)) < np.timedelta64(330, "s")
        assert one.begin <= one.time <= one.end
        assert np.all(np.abs(one.change_nt - [350.0, -250.0, 250.0]) < 4.5 * one.standard_errors_nt)


def test_two_steps_are_both_named_in_the_order_of_time_and_not_three():
    plain = session(420)
    moved = sum(step_nt(plain, at, change) for at, change in ((0.3, CHANGE), (0.65, (-300.0, 300.0, 100.0))))
    found = mc.bias_steps(moments_of(session(420, moved), "vector"))
    for one, share in zip(found.items, (0.3, 0.65), strict=True):
        assert abs(one.time - time_of(plain, share)) < np.timedelta64(330, "s")
    third = moved + step_nt(plain, 0.8, (500.0, 0.0, -400.0))
    assert len(mc.bias_steps(moments_of(session(420, third), "vector")).items) == 2


def test_the_banded_solution_is_that_of_all_unknowns_in_one_matrix():
    """Normal matrix of fit, step and wandering bias written out, its determinant and its inverse by LAPACK."""
    blocks = wb.Blocks.of(moments_of(session(430), "vector")).together(6)
    model, steps, m, q = wb.Wander(2700.0, 0.4), [5], len(blocks), 9
    found = wb.solved(blocks, wb.Process.of(blocks, model), steps)
    own = blocks.normals[:, wb.BIAS, wb.BIAS]
    size = q + 3 + 3 * m
    whole, score = np.zeros((size, size)), np.zeros(size)
    for b in range(m):
        carry = np.zeros((q, size))
        carry[:, :q] = np.eye(q)
        carry[wb.BIAS, q : q + 3] = np.eye(3) * (b >= steps[0])
        carry[wb.BIAS, q + 3 + 3 * b : q + 6 + 3 * b] = np.eye(3)
        whole += carry.T @ blocks.normals[b] @ carry
        score += carry.T @ blocks.scores[b]
    covariance = np.exp(-np.abs(np.subtract.outer(blocks.middle_s, blocks.middle_s)) / model.memory_s)
    precision = np.kron(np.linalg.inv(covariance) / model.deviation**2, np.eye(3))
    whole[q + 3 :, q + 3 :] += precision
    whole[q : q + 3, q : q + 3] += np.eye(3) * blocks.costs.sum() / blocks.freedom / wb.STEP_PRIOR_NT**2
    scale = np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole / np.outer(scale, scale)) / np.outer(scale, scale)
    estimate = -inverse @ score
    rss = blocks.costs.sum() + score @ estimate
    assert found.rss == pytest.approx(rss, rel=1e-9)
    np.testing.assert_allclose(np.concatenate([found.estimate, found.bias]), estimate, rtol=1e-5, atol=1e-6)
    determinant = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(precision)[1]
    assert found.log_determinant == pytest.approx(determinant, abs=1e-5)
    np.testing.assert_allclose(found.inverse, inverse[: q + 3, : q + 3], rtol=1e-5, atol=1e-12)
    place = 11
    column, moved = np.zeros((size, 3)), np.zeros((3, 3))
    for b in range(place, m):
        carry = np.zeros((q, size))
        carry[:, :q] = np.eye(q)
        carry[wb.BIAS, q : q + 3] = np.eye(3) * (b >= steps[0])
        carry[wb.BIAS, q + 3 + 3 * b : q + 6 + 3 * b] = np.eye(3)
        column += carry.T @ blocks.normals[b][:, wb.BIAS]
        moved += own[b]
    information, told = wb.step_information(blocks, steps, found, np.array([place]))
    np.testing.assert_allclose(information[0], moved - column.T @ inverse @ column, rtol=1e-6)
    wanted = blocks.scores[place:, wb.BIAS].sum(axis=0) + column.T @ estimate
    np.testing.assert_allclose(told[0], wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())


def test_the_likelihoods_of_all_noise_models_are_those_of_each_one_solved():
    """Rounding of log det alone: some hundred terms of size 10."""
    blocks = wb.Blocks.of(moments_of(session(430), "vector")).together(6)
    models = (wb.Wander(0.0, 0.0), wb.Wander(2700.0, 0.4), wb.Wander(600.0, 0.05), wb.Wander(0.0, 0.0))
    alone = [wb.solved(blocks, wb.Process.of(blocks, model), ()).log_likelihood for model in models]
    np.testing.assert_allclose(wb.plain_log_likelihoods(blocks, models), alone, rtol=0.0, atol=1e-6)
    assert len(set(alone)) == 3


def test_the_quick_look_finds_nothing_only_where_the_whole_search_does(monkeypatch):
    from magcal_core.calibration.terms import bias_steps as module

    plain = session(440)
    every = [
        moments_of(session(440 + seed, step_nt(plain, 0.4, tuple(size * np.array([0.7, -0.5, 0.5])))), "scalar")
        for seed, size in enumerate((0.0, 60.0, 120.0, 200.0))
    ]
    quick = [len(mc.bias_steps(one).items) for one in every]
    monkeypatch.setattr(module, "_NOTHING", -1.0)
    assert [len(mc.bias_steps(one).items) for one in every] == quick


def test_ninety_six_blocks_take_less_than_three_seconds():
    plain = session(450)
    moments = moments_of(session(450, step_nt(plain, 0.4, CHANGE)))
    assert len(moments.begins) >= 80
    mc.bias_steps(moments)
    begun = time.process_time()
    assert len(mc.bias_steps(moments).items) == 1
    assert time.process_time() - begun < 3.0


def test_nothing_is_looked_for_where_the_data_hardly_determine_the_fit():
    short = session(460, hours=0.5)
    found = mc.calibrate(short, method="scalar")
    assert (found.to_dict()["bias_steps"]["state"] == "searched") == (found.observability.index >= WEAK_BELOW)
    weak = replace(found.observability, index=0.99 * WEAK_BELOW)
    moments = moments_of(session(460, step_nt(session(460), 0.4, CHANGE)))
    assert len(steps_of_session(moments, replace(weak, index=WEAK_BELOW)).items) == 1
    assert steps_of_session(moments, weak).state == "not_searched"
    closed = mc.calibrate(session(460), method="vector-closed-form").to_dict()
    assert (closed["bias_steps"]["state"], closed["bias_steps"]["items"]) == ("not_searched", [])


@pytest.mark.parametrize("method", ["scalar-hooke-jeeves", "vector-closed-form"])
def test_a_method_that_takes_no_regressors_cannot_fit_steps(method):
    with pytest.raises(OptionError, match="cannot fit steps"):
        mc.calibrate(session(460), method=method, bias_steps="fit")


def test_the_path_follows_a_step_and_a_drift_and_stays_where_nothing_moves():
    """RMS over the blocks against the truth: a third of what one bias for all of the session leaves, at most."""
    plain = session(470)
    hours = np.arange(len(plain))[:, None] / 240.0
    for moved in (step_nt(plain, 0.45, CHANGE), 150.0 * (hours - 1.5) * [1.0, -0.7, 0.5]):
        path = mc.bias_path(moments_of(session(470, moved), "vector"))
        at = np.searchsorted(plain.t_utc, path.t_utc).clip(max=len(plain) - 1)
        truth = SENSOR.bias_nt + moved[at]
        still = np.sqrt(np.mean((path.own_bias_nt - truth) ** 2))
        assert np.sqrt(np.mean((path.bias_nt - truth) ** 2)) < still / 2.5
        held = np.abs(path.bias_nt - truth) < 1.96 * path.standard_errors_nt
        assert held.mean() > 0.75
    path = mc.bias_path(moments_of(plain, "vector"))
    assert np.ptp(path.bias_nt, axis=0).max() < 15.0
    assert path.steps == ()


def test_moments_read_from_a_file_name_the_same_steps_and_path():
    plain = session(480)
    moments = moments_of(session(480, step_nt(plain, 0.4, CHANGE)))
    again = FitMoments.from_bytes(moments.to_bytes())
    (one,), (other,) = mc.bias_steps(moments).items, mc.bias_steps(again).items
    assert one.time == other.time
    np.testing.assert_allclose(one.change_nt, other.change_nt, rtol=1e-3)
    np.testing.assert_allclose(mc.bias_path(moments).bias_nt, mc.bias_path(again).bias_nt, rtol=1e-3)


def test_a_later_session_is_judged_against_the_bias_after_the_step():
    plain = session(490)
    fitted = mc.calibrate(session(490, step_nt(plain, 0.4, (600.0, 0.0, 0.0))), method="vector", bias_steps="fit")
    record = fitted.to_dict()
    active = ActiveSet.from_record(record)
    assert (dict(active.parameters.regressors), active.covariance.shape) == ({}, (9, 9))
    later = session(491, np.tile([600.0, 0.0, 0.0], (len(plain), 1)))
    later = replace(later, t_utc=later.t_utc + np.timedelta64(5, "D"))
    assert monitor(later, [], record).grade == "agrees"
    new = mc.calibrate(later, method="vector", active=active)
    assert not new.to_dict()["agreement"]["differs"]


def test_a_step_is_a_regressor_by_name():
    plain = session(500)
    at = time_of(plain, 0.5)
    name = f"before:{np.datetime_as_string(at, unit='us')}Z"
    np.testing.assert_array_equal(step_column(name, plain.t_utc), plain.t_utc < at)
    moved = session(500, step_nt(plain, 0.5, CHANGE))
    found = mc.calibrate(moved, method="vector", regressors=(name,), bias_steps="none")
    np.testing.assert_allclose(-found.parameters.regressors[name], CHANGE, atol=60.0)
    for bad in ("before:noon", "before:2022-02-20T00:00:00"):
        with pytest.raises(OptionError, match="want before:TIME"):
            mc.calibrate(plain, method="vector", regressors=(bad,))


def test_the_path_of_a_fit_with_steps_has_the_bias_on_both_sides():
    plain = session(510)
    moved = step_nt(plain, 0.4, (600.0, -300.0, 0.0))
    fitted = mc.calibrate(session(510, moved), method="vector", bias_steps="fit", with_moments=True)
    assert fitted.moments is not None
    path = mc.bias_path(fitted.moments)
    assert path.steps == ()
    at = np.searchsorted(plain.t_utc, path.t_utc).clip(max=len(plain) - 1)
    away = np.abs(path.bias_nt - SENSOR.bias_nt - moved[at])
    assert np.all(away < 4.5 * path.standard_errors_nt + 5.0)
    np.testing.assert_allclose(path.own_bias_nt, fitted.parameters.bias_nt)
