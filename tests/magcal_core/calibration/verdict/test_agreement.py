"""A calibration beside the one in force: what is the same passes for the same, and what has changed is told."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.sessions.monitoring import ActiveSet
from magcal_core.calibration.verdict.agreement import agreement_with
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel


def active_of(found):
    return ActiveSet.from_record(found.to_dict())


def test_sessions_of_one_sensor_agree(mission):
    """One pair in a thousand may differ significantly, and none of forty by 1 % of the field."""
    active = active_of(calibrate(mission(seed=100).samples))
    found = [calibrate(mission(seed=seed).samples, active=active) for seed in range(40)]
    assert not [one for one in found if "differs_from_active" in " ".join(str(r) for r in one.verdict.reasons)]
    assert sum(one.extras["agreement"]["p_value"] < 1e-3 for one in found) <= 1


def test_a_sensor_that_changed_is_told_and_weakens_the_verdict(mission):
    """1500 nT on axis 2 are 4 % of the field: found with their size, within four standard errors of the difference."""
    active = active_of(calibrate(mission(seed=100).samples))
    samples = mission(seed=3).samples
    samples = replace(samples, h_nt=samples.h_nt + np.array([0.0, 1500.0, 0.0]))
    moved = calibrate(samples, active=active)
    assert moved.verdict.grade == "weak"
    (reason,) = moved.verdict.reasons
    assert reason.code == "differs_from_active"
    assert "bias_nt[1]" in reason.text
    agreement = moved.extras["agreement"]
    worst = agreement["differences"][0]
    assert worst["difference"] == pytest.approx(1500.0, abs=4 * worst["standard_error"])
    assert agreement["differs"]
    assert calibrate(samples).verdict.grade == "accept"


def test_the_field_changes_by_what_the_two_corrections_differ(mission):
    """Against both corrections of the same readings, over directions at random: to second order in the differences."""
    first = calibrate(mission(seed=1).samples)
    sensor = SensorModel([3100.0, -1191.25, -1875.625], [1.04, 1.006685, 1.032875], [-4.53, -0.8, 7.915])
    second = calibrate(mission(seed=2, sensor=sensor).samples, active=active_of(first))
    agreement = second.extras["agreement"]
    mean_nt = float(np.mean(mission(seed=2).samples.b_ref_magnitude_nt))
    directions = np.random.default_rng(1).normal(size=(20_000, 3))
    readings = first.parameters.bias_nt + mean_nt * (
        directions / np.linalg.norm(directions, axis=1)[:, None] @ first.matrix.T
    )
    one, other = ((readings - x.parameters.bias_nt) @ x.correction_matrix.T for x in (first, second))
    change_nt = float(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=1))))
    assert agreement["field_change_nt"] == pytest.approx(change_nt, rel=0.05)


def test_what_cannot_be_compared_is_not(mission):
    scalar = calibrate(mission(seed=1).samples)
    active = active_of(scalar)
    vector = calibrate(mission(seed=1).samples, method="vector", active=active)
    assert "agreement" not in vector.extras
    p, covariance = scalar.parameters, scalar.covariance
    warmer = replace(active, parameters=replace(active.parameters, regressors={"temperature": np.ones(3)}))
    assert agreement_with(warmer, p, covariance, 4e4, is_vector=False) is None
    unknown = replace(active, covariance=np.full_like(covariance, np.nan))
    assert agreement_with(unknown, p, covariance, 4e4, is_vector=False) is None
    assert agreement_with(active, p, covariance, 4e4, is_vector=False).p_value == 1.0
