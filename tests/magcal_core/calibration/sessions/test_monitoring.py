"""A session judged without refitting must say what a refit would say, in milliseconds."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.scalar import ScalarFit
from magcal_core.calibration.estimators.vector import VectorFit
from magcal_core.calibration.sessions.monitoring import ActiveSet, judge_moments, judge_session, moments_of
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, honest_covariance
from magcal_core.errors import InputError, OptionError
from magcal_core.observations import Observations
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.telemetry import Disturbances, simulate

SENSOR = SensorModel(np.array([2900.0, -1200.0, -1900.0]), np.array([1.03, 1.01, 1.04]), np.array([-4.0, -1.5, 7.0]))
MOVED = replace(SENSOR, bias_nt=SENSOR.bias_nt + np.array([600.0, 0.0, -500.0]))


@pytest.fixture(scope="module")
def orbit(data_dir: Path) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))


def session(orbit, sensor, seed: int, *, samples: int = 600, days: int = 0, **more) -> Observations:
    start = np.datetime64("2022-02-19T22:37:44") + np.timedelta64(days, "D")
    disturbed = Disturbances(noise_nt=80.0, **more)
    made = simulate(orbit, sensor, start, samples * 10.0, 10.0, disturbances=disturbed, seed=seed)
    return Observations.of(made.samples_with_reference, ["temperature"] if made.samples.housekeeping else [])


def active_of(observations: Observations, *, is_vector: bool = False) -> ActiveSet:
    fit = (VectorFit() if is_vector else ScalarFit()).fit(observations, FitSettings())
    honest = honest_covariance(fit.blocks, fit.covariance, len(observations), covered_s(observations.t_s)).covariance
    return ActiveSet(fit.parameters, honest, float(np.sqrt(np.mean(fit.residuals_nt**2))), is_vector)


@pytest.mark.parametrize("is_vector", [False, True])
def test_the_drift_is_that_of_a_refit(orbit, is_vector: bool) -> None:
    """One Gauss-Newton step over 800 nT neglects (800 nT / 35 uT)^2 / 2, less than a standard error."""
    active = active_of(session(orbit, SENSOR, 1), is_vector=is_vector)
    new = session(orbit, MOVED, 2, days=1)
    found = judge_session(new, active)
    refit = (VectorFit() if is_vector else ScalarFit()).fit(new, FitSettings())
    drifts = {one.parameter: one for one in found.drifts}
    for i, name in enumerate(refit.parameters.names):
        change = refit.parameters.vector[i] - active.parameters.vector[i]
        assert abs(drifts[name].difference - change) < drifts[name].standard_error
    assert found.grade == "disagrees"
    assert found.reasons[0].code == "parameter_drift"
    assert found.drifts[0].parameter in {"bias_nt[0]", "bias_nt[2]"}
    assert found.field_change_nt == pytest.approx(np.linalg.norm([600.0 / 1.03, 500.0 / 1.04]), rel=0.15)


def test_a_session_of_the_same_sensor_agrees(orbit) -> None:
    """Twelve sessions with a 250 nT wave in the bias: at a level of 1e-3 none may be called drifted."""
    wave = {"wave_nt": (250.0, 0.0, 0.0)}
    active = active_of(session(orbit, SENSOR, 1, samples=1150, **wave))
    for seed in range(2, 14):
        found = judge_session(session(orbit, SENSOR, seed, days=seed, samples=700, **wave), active)
        assert found.grade == "agrees", found.reasons


def test_a_short_pass_sees_a_large_drift_and_no_small_one(orbit) -> None:
    active = active_of(session(orbit, SENSOR, 1, samples=1150))
    short = judge_session(session(orbit, SENSOR, 5, samples=60, days=2), active)
    assert short.grade in {"agrees", "watch"}
    assert all(np.isfinite(one.standard_error) for one in short.drifts)
    far = replace(SENSOR, bias_nt=SENSOR.bias_nt + np.array([5000.0, -4000.0, 3000.0]))
    assert judge_session(session(orbit, far, 6, samples=60, days=2), active).grade == "disagrees"


def test_a_session_that_turns_about_one_axis_does_not_run_away(orbit) -> None:
    active = active_of(session(orbit, SENSOR, 1))
    made = simulate(
        orbit, SENSOR, np.datetime64("2022-02-20T01:00:00"), 1200.0, 10.0,
        rate_deg_s=(0.0, 0.0, 1.0), disturbances=Disturbances(noise_nt=80.0), seed=3,
    )  # fmt: skip
    found = judge_session(Observations.of(made.samples_with_reference), active)
    assert found.grade == "agrees"
    assert found.p_value > 1e-3


def test_too_few_samples_are_not_judged(orbit) -> None:
    active = active_of(session(orbit, SENSOR, 1))
    assert judge_session(session(orbit, SENSOR, 2, samples=11), active).grade == "too_short"


def test_noise_that_grows_is_watched_then_refused(orbit) -> None:
    active = active_of(session(orbit, SENSOR, 1))
    grades = []
    for noise_nt in (80.0, 200.0, 400.0):
        start = np.datetime64("2022-02-21T01:00:00")
        made = simulate(orbit, SENSOR, start, 6000.0, 10.0, disturbances=Disturbances(noise_nt), seed=4)
        grades.append(judge_session(Observations.of(made.samples_with_reference), active).grade)
    assert grades == ["agrees", "watch", "disagrees"]


def test_regressors_of_the_active_set_are_taken_off(orbit) -> None:
    warm = {"temperature_nt_per_k": (20.0, -10.0, 5.0)}
    active = active_of(session(orbit, SENSOR, 1, **warm))
    assert "temperature" in active.parameters.regressors
    new = session(orbit, SENSOR, 2, days=1, **warm)
    found = judge_session(new, active)
    assert found.grade == "agrees"
    assert found.residual_ratio == pytest.approx(1.0, abs=0.15)
    with pytest.raises(OptionError, match="temperature"):
        judge_session(replace(new, regressors={}), active)


def test_stored_moments_say_what_the_samples_say(orbit) -> None:
    active = active_of(session(orbit, SENSOR, 1))
    new = session(orbit, MOVED, 2, days=1)
    moments = moments_of(new, active.parameters, is_vector=False)
    assert judge_moments(moments, active).to_dict() == judge_session(new, active).to_dict()


def test_the_active_set_is_read_from_its_record(orbit) -> None:
    active = active_of(session(orbit, SENSOR, 1))
    record = {
        "method": "scalar",
        "parameters": active.parameters.to_dict(),
        "covariance": active.covariance.tolist(),
        "statistics": {"after": {"rms_nt": active.residual_rms_nt}},
    }
    new = session(orbit, MOVED, 2, days=1)
    assert judge_session(new, ActiveSet.from_record(record)).to_dict() == judge_session(new, active).to_dict()
    with pytest.raises(InputError):
        ActiveSet.from_record({"parameters": {}})


def short_session(samples: int, rng: np.random.Generator, motion: str) -> Observations:
    """Return a session of `SENSOR` at 10 s with 80 nT of noise: directions at random, or a tumble at 0.5 to 3 deg/s."""
    t_s = 10.0 * np.arange(samples)
    if motion == "random":
        u = rng.normal(size=(samples, 3))
    else:
        turn = np.deg2rad(rng.uniform(0.5, 3.0)) * t_s
        u = np.column_stack([np.cos(turn), 0.8 * np.sin(turn), 0.6 * np.sin(turn)]) * np.cos(0.41 * turn)[:, None]
        u += np.sin(0.41 * turn)[:, None] * np.array([0.0, 0.6, 0.8])
        u = u @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    b_nt = 35e3 + 8e3 * np.sin(2.0 * np.pi * t_s / 5700.0 + rng.uniform(0.0, 6.0))
    h_nt = SENSOR.apply(b_nt[:, None] * u) + 80.0 * rng.normal(size=(samples, 3))
    return Observations(
        t_s, np.ascontiguousarray(h_nt), b_nt, np.ascontiguousarray(b_nt[:, None] * u), np.ones(samples)
    )


@pytest.mark.parametrize(
    ("samples", "motion", "is_vector"),
    [(12, "random", False), (16, "random", False), (30, "tumble", False), (12, "random", True)],
)
def test_short_sessions_of_a_sound_sensor_are_seldom_called_drifted(samples: int, motion: str, is_vector: bool) -> None:
    """The stated rate is 0.1 %: 0.4 of 400 sessions; four and more would be one run in a thousand.

    Measured over 1,000 sessions each: 0.1 % or less. With the normal law it was 5 % at 12 samples and 1.7 % at 16;
    without the part of the noise that |B| makes a drift of, 2.5 % of the tumbles.
    """
    known = Parameters(SENSOR.bias_nt, SENSOR.scale, SENSOR.nonorthogonality_deg)
    active = ActiveSet(known, np.diag([0.02] * 3 + [5e-7] * 3 + [3e-5] * 3) ** 2, 80.0, is_vector)
    rng = np.random.default_rng(samples)
    found = [judge_session(short_session(samples, rng, motion), active) for _ in range(400)]
    assert sum(one.p_value < 1e-3 for one in found) <= 3


def test_a_short_session_still_shows_what_is_many_errors_large() -> None:
    """16 samples leave seven residuals: 5 uT are some 60 standard errors of 80 nT noise."""
    rng = np.random.default_rng(1)
    known = Parameters(SENSOR.bias_nt - np.array([5000.0, 0.0, 0.0]), SENSOR.scale, SENSOR.nonorthogonality_deg)
    active = ActiveSet(known, np.diag([20.0] * 3 + [5e-4] * 3 + [0.03] * 3) ** 2, 80.0, is_vector=False)
    grades = [judge_session(short_session(16, rng, "random"), active).grade for _ in range(20)]
    assert grades.count("disagrees") >= 19


def as_postgresql_has_it(value):
    """Return a record as JSONB gives it back: keys by their length, then by their bytes."""
    if isinstance(value, dict):
        return {key: as_postgresql_has_it(value[key]) for key in sorted(value, key=lambda k: (len(k), k.encode()))}
    return [as_postgresql_has_it(one) for one in value] if isinstance(value, list) else value


def with_columns(o: Observations, seed: int, *, moved: float = 0.0) -> Observations:
    """Return the observations with a warm-up of some degrees and a current of some tens of mA, and what they do."""
    noise = np.random.default_rng(seed).normal(size=(2, len(o)))
    warm, current = 10.0 * np.sin(o.t_s / 900.0) + noise[0], 0.02 * (np.sin(o.t_s / 70.0) > 0) + 1e-4 * noise[1]
    h_nt = o.h_nt + warm[:, None] * [20.0, -10.0, 5.0] + current[:, None] * [9e3, 6e3 + moved, -4e3]
    return replace(o, h_nt=h_nt, regressors={"temperature": warm, "amps": current})


def test_the_order_of_keys_in_a_record_says_nothing(orbit) -> None:
    """JSONB turns temperature, amps to amps, temperature; slopes and errors differ by a factor of 600."""
    active = active_of(with_columns(session(orbit, SENSOR, 1, samples=1150), 1))
    record = {
        "method": "scalar",
        "parameters": active.parameters.to_dict(),
        "parameter_names": list(active.parameters.names),
        "covariance": active.covariance.tolist(),
        "statistics": {"after": {"rms_nt": active.residual_rms_nt}},
    }
    sorted_record = as_postgresql_has_it(record)
    assert list(sorted_record["parameters"]["regressors"]) == ["amps", "temperature"]
    new = with_columns(session(orbit, MOVED, 2, days=1), 2, moved=5e4)
    expected = judge_session(new, active)
    assert {drift.parameter for drift in expected.drifts[:3]} & {"regressors.amps[1]"}
    assert judge_session(new, ActiveSet.from_record(record)).to_dict() == expected.to_dict()
    assert judge_session(new, ActiveSet.from_record(sorted_record)).to_dict() == expected.to_dict()
    del sorted_record["parameter_names"]
    with pytest.raises(InputError, match="parameter_names"):
        ActiveSet.from_record(sorted_record)


def test_the_errors_of_a_set_with_terms_of_the_scale_are_those_of_their_names(orbit) -> None:
    """A term of the scale before one of the bias: the judgement takes the errors of the latter."""
    active = active_of(with_columns(session(orbit, SENSOR, 1, samples=1150), 1))
    p = active.parameters
    first = replace(p, regressors={"amps*h": np.zeros(3), **p.regressors})
    at = [first.names.index(name) for name in p.names]
    covariance = 1e6 * np.eye(len(first.names))
    covariance[np.ix_(at, at)] = active.covariance
    longer = replace(active, parameters=first, covariance=covariance)
    new = with_columns(session(orbit, MOVED, 2, days=1), 2)
    product = new.regressors["amps"][:, None] * new.h_nt
    wider = replace(new, regressors={"amps*h": product, **new.regressors})
    assert judge_session(wider, longer).to_dict() == judge_session(new, active).to_dict()


def test_a_judgement_takes_milliseconds(orbit) -> None:
    """Processor time of one call; 20 ms allow for a machine at work on other things."""
    active, new = active_of(session(orbit, SENSOR, 1)), session(orbit, MOVED, 2, days=1)
    durations = []
    for _ in range(10):
        begin = time.process_time()
        judge_session(new, active)
        durations.append(time.process_time() - begin)
    assert min(durations) < 0.02
