"""Joint fits and monitoring know of errors that no residual shows: of the reference, and locked to the orbit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from magcal_core.calibration.sessions.joint import joint_fit
from magcal_core.calibration.sessions.monitoring import ActiveSet, judge_session
from magcal_core.estimation.session import LockedSession
from magcal_core.estimation.surrounded_session import SurroundedSession
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.pipeline import calibrate
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.sessions import calibrate_jointly
from magcal_core.simulation.missions import draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

START = np.datetime64("2022-01-01", "ns")
SENSOR = SensorModel([2000.0, -1500.0, 800.0], [1.02, 0.97, 1.01], [1.0, -2.0, 1.5])
LACKING = 3e-4
"""What the model lacks of the field, as a share: some 10 nT, which no residual of |B| shows."""


@cache
def sessions() -> tuple[dict[str, Samples], object]:
    """Two sessions, a day apart, in a field that is a little larger than the model's."""
    orbit = draw_orbit(np.random.default_rng(3), START)
    made = {}
    for i in range(2):
        at = START + np.timedelta64(i, "D")
        samples = simulate(
            orbit, SENSOR, at, 7000.0, 10.0, rate_deg_s=0.5, disturbances=Disturbances(30.0), seed=i
        ).samples
        bias = np.asarray(SENSOR.bias_nt)
        made[f"day {i}"] = replace(samples, h_nt=bias + (samples.h_nt - bias) * (1.0 + LACKING))
    return made, orbit


def parts(method: str) -> tuple[list[Observations], list[SurroundedSession]]:
    """Return what a joint fit is made of."""
    made, orbit = sessions()
    options = CalibrationOptions(method=method)
    observed, around = [], []
    for samples in made.values():
        referenced = Referenced.of(samples, [orbit], options)
        usable = referenced.usable((), is_vector=method == "vector")
        observed.append(referenced.observations(usable, ()))
        around.append(SurroundedSession(LockedSession(referenced, usable, method == "vector"), True, False))
    return observed, around


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_a_joint_fit_s_interval_holds_what_the_reference_lacks(method: str) -> None:
    observed, around = parts(method)
    truth = np.asarray(SENSOR.scale)
    off, errors = {}, {}
    for name, surrounded in (("alone", None), ("known", around)):
        found = joint_fit(observed, is_vector=method == "vector", surrounded=surrounded).sessions[0]
        off[name] = np.abs(found.parameters.scale - truth)
        errors[name] = found.standard_errors.scale
    np.testing.assert_array_equal(off["alone"], off["known"])
    assert np.max(off["alone"] / errors["alone"]) > 3.0
    assert np.max(off["known"] / errors["known"]) < 2.0


def test_one_session_alone_is_as_uncertain_jointly_as_by_itself() -> None:
    """Within a third: blocks are cut otherwise, and honest errors come from them."""
    made, orbit = sessions()
    name, samples = next(iter(made.items()))
    joint = calibrate_jointly({name: samples}, [orbit]).sessions[0].standard_errors.vector
    alone = calibrate(samples, [orbit], time_offset="none").standard_errors.vector
    np.testing.assert_allclose(joint, alone, rtol=0.33)


def test_what_the_reference_lacks_is_no_drift_of_the_sensor() -> None:
    """A set from long data in another field is known to 1e-4; the session is not."""
    observed, around = parts("scalar")
    small = np.diag(np.array([3.0, 3.0, 3.0, 1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01]) ** 2)
    angles = np.asarray(SENSOR.nonorthogonality_deg)
    active = ActiveSet(Parameters(np.asarray(SENSOR.bias_nt), np.asarray(SENSOR.scale), angles), small, 30.0, False)
    blind, told = judge_session(observed[0], active), judge_session(observed[0], active, around[0])
    assert told.p_value > 0.01
    assert blind.p_value < told.p_value
    assert told.grade == "agrees"
    by_name = {one.parameter: one.standard_error for one in blind.drifts}
    assert all(one.standard_error >= by_name[one.parameter] * (1.0 - 1e-9) for one in told.drifts)


def test_a_real_drift_is_still_one() -> None:
    """A bias that moved by 2000 nT is seen beside everything that may be hidden."""
    observed, around = parts("scalar")
    small = np.diag(np.array([3.0, 3.0, 3.0, 1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.01]) ** 2)
    moved = np.asarray(SENSOR.bias_nt) + np.array([2000.0, 0.0, 0.0])
    angles = np.asarray(SENSOR.nonorthogonality_deg)
    active = ActiveSet(Parameters(moved, np.asarray(SENSOR.scale), angles), small, 30.0, False)
    assert judge_session(observed[0], active, around[0]).grade == "disagrees"
