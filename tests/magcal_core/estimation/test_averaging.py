"""Calibrations of a spinning satellite whose sensor averages: attitude, gyros, and where nothing tells the rate."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magcal_core.errors import OptionError
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.sessions import monitor
from magcal_core.simulation.dekart_mission import tle_text
from magcal_core.simulation.telemetry import simulate

START = np.datetime64("2022-02-19T22:37:44", "ns")
PARTS = 20
"""Instants of the true field in a second, which the sensor averages over."""
RATE_DEG_S = (14.0, -10.0, 18.0)
SENSOR = SensorModel(
    bias_nt=np.array([2100.0, -900.0, 400.0]),
    scale=np.array([1.02, 0.97, 1.05]),
    nonorthogonality_deg=np.array([0.6, -0.4, 0.3]),
)
PLAIN = {"robust": "none", "noise_model": "none", "time_offset": "none", "locked_terms": "none"}
TURN = Rotation.from_rotvec([0.5, -0.8, 0.3]).as_matrix()
"""From the gyro axes to the base frame."""


@cache
def orbit() -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join(tle_text().splitlines()[:3]))


@cache
def spinning(seed: int = 3, duration_s: float = 1200.0) -> Samples:
    """A free body at 25 deg/s, a reading a second over that whole second, its attitude and its gyros at the middle."""
    fine = simulate(
        orbit(), SENSOR, START, duration_s, 1.0 / PARTS, rate_deg_s=RATE_DEG_S, moments=(0.05, 0.04, 0.06), seed=seed
    )
    middles = np.arange(PARTS, len(fine.samples) - PARTS, PARTS)
    weights = np.r_[0.5, np.ones(PARTS - 1), 0.5] / PARTS
    around = middles[:, None] + np.arange(-(PARTS // 2), PARTS // 2 + 1)
    b_nt = np.einsum("k,nkj->nj", weights, fine.b_base_nt[around])
    h_nt = SENSOR.apply(b_nt) + 20.0 * np.random.default_rng(seed).normal(size=b_nt.shape)
    q = fine.samples.q_base_gcrf
    turns = Rotation.from_quat(q, scalar_first=True)
    step = (turns[middles - 1].inv() * turns[middles + 1]).as_rotvec() * PARTS / 2.0
    gyros = np.rad2deg(step @ TURN) + np.array([0.02, -0.03, 0.01])
    columns = {f"w{axis}": gyros[:, i].copy() for i, axis in enumerate("xyz")}
    return Samples(fine.samples.t_utc[middles], h_nt, q[middles], housekeeping=columns)


def scale_error(calibration) -> np.ndarray:
    return calibration.parameters.scale / SENSOR.scale - 1.0


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_averaging_makes_scale_factors_small_and_the_integration_time_mends_it(method):
    """A second at 25 deg/s takes 0.8 % of what lies across the axis; 20 nT of noise leave 0.005 % of 1160 readings."""
    plain, known = (
        calibrate(spinning(), [orbit()], method=method, integration_s=time_s, **PLAIN) for time_s in (None, 1.0)
    )
    assert scale_error(plain).mean() < -0.003
    assert np.abs(scale_error(known)).max() < 5e-4
    assert known.after.rms_nt < 0.5 * plain.after.rms_nt
    assert "averaging" not in plain.to_dict()
    said = known.to_dict()["averaging"]
    assert said["is_used"]
    assert said["rate_from"] == "quaternions"
    assert said["samples"] == len(spinning())
    assert said["rate_deg_s"] == pytest.approx(np.linalg.norm(RATE_DEG_S), rel=0.1)
    assert 0.003 < said["loss_share"] < 0.009
    assert not any(text.startswith("averaging_not_used") for text in known.warnings)
    assert not any(one["source"] == "sensor_averaging" for one in known.to_dict()["error_budget"])


def slow_spin() -> Samples:
    """A tumble of 1.4 deg/s, a momentary reading every 20 s: nobody can see that they are momentary."""
    return simulate(orbit(), SENSOR, START, 6000.0, 20.0, rate_deg_s=(0.8, -0.6, 1.0), seed=3).samples


def test_averaging_that_nobody_spoke_of_is_told():
    """The field turns by up to 25 deg a second: the share told is what the scale factors lack, or a little more.

    A half more at most: the readings turn by what lies across the axis alone. Where an integration time is given, none
    or another, and where the sensor hardly turns between two readings, there is nothing to tell.
    """
    plain = calibrate(spinning(), [orbit()], method="vector", **PLAIN)
    (told,) = [text for text in plain.warnings if text.startswith("averaging_not_known")]
    share = float(told.split("reads up to ")[1].split(" of it")[0])
    assert 1.0 < share / -scale_error(plain).mean() < 1.5
    for time_s in (0.0, 1.0):
        said = calibrate(spinning(), [orbit()], method="vector", integration_s=time_s, **PLAIN).warnings
        assert not [text for text in said if text.startswith("averaging_not_known")]
    sparse = spinning().take(np.arange(0, len(spinning()), 2))
    (told,) = [
        text for text in calibrate(sparse, [orbit()], **PLAIN).warnings if text.startswith("averaging_not_known")
    ]
    assert "over these 2 s" in told
    (told,) = [
        text for text in calibrate(slow_spin(), [orbit()], **PLAIN).warnings if text.startswith("averaging_not_known")
    ]
    assert "over these 20 s" in told
    slow = simulate(orbit(), SENSOR, START, 6000.0, 10.0, rate_deg_s=(0.05, -0.03, 0.06), seed=3).samples
    said = calibrate(slow, [orbit()], method="vector", **PLAIN).warnings
    assert not [text for text in said if text.startswith("averaging_not_known")]


def test_the_reference_at_the_clocks_own_time_is_the_averaged_one():
    """The search for the clock asks for the field again; what it gets is averaged as well, with attitude or |B|."""
    options = CalibrationOptions(integration_s=1.0)
    for samples in (spinning(), replace(spinning(), q_base_gcrf=_with_gap(spinning().q_base_gcrf))):
        referenced = Referenced.of(samples, [orbit()], options)
        usable = referenced.usable((), False)
        here = referenced.observations(usable, ())
        moved = referenced.movable(usable, ()).at(np.zeros(len(here)))
        # The polynomials of the field along the orbit are good to 0.01 nT.
        np.testing.assert_allclose(moved.b_nt, here.b_nt, atol=0.05)
        plain = Referenced.of(samples, [orbit()], CalibrationOptions()).observations(usable, ())
        assert np.mean(here.b_nt - plain.b_nt) < -50.0


def _with_gap(q: np.ndarray) -> np.ndarray:
    """Attitudes of which some are missing: |B| is then all that an estimator sees."""
    some = q.copy()
    some[100:110] = np.nan
    return some


def test_gyros_tell_the_rate_where_there_is_no_attitude():
    samples = replace(spinning(), q_base_gcrf=None)
    known = calibrate(samples, [orbit()], integration_s=1.0, gyro=("wx", "wy", "wz"), **PLAIN)
    assert np.abs(scale_error(known)).max() < 1e-3
    said = known.to_dict()["averaging"]
    assert said["rate_from"] == "gyros"
    assert said["rate_deg_s"] == pytest.approx(np.linalg.norm(RATE_DEG_S), rel=0.1)


def test_a_rate_that_is_not_known_is_said_and_bounded_by_the_readings():
    """The bias of the scale stays; the record has its size, a line in the budget, and a warning."""
    samples = replace(spinning(), q_base_gcrf=None, housekeeping={})
    plain, told = (calibrate(samples, [orbit()], integration_s=time_s, **PLAIN) for time_s in (None, 1.0))
    np.testing.assert_array_equal(told.parameters.vector, plain.parameters.vector)
    said = told.to_dict()["averaging"]
    assert not said["is_used"]
    assert said["rate_from"] is None
    true_loss = -scale_error(plain).mean()
    assert said["unknown_share"] == pytest.approx(true_loss, rel=0.3)
    (line,) = [one for one in told.to_dict()["error_budget"] if one["source"] == "sensor_averaging"]
    assert line["rms_nt"] == pytest.approx(true_loss * np.mean(plain.residuals.model_nt), rel=0.3)
    (warning,) = [text for text in told.warnings if text.startswith("averaging_not_used")]
    assert "no attitude" in warning


def test_readings_far_apart_bound_nothing_and_that_is_said():
    samples = replace(spinning(), q_base_gcrf=None, housekeeping={}).take(slice(None, None, 12))
    told = calibrate(samples, [orbit()], integration_s=1.0, **PLAIN).to_dict()
    assert told["averaging"]["unknown_share"] is None
    (line,) = [one for one in told["error_budget"] if one["source"] == "sensor_averaging"]
    assert line["rms_nt"] is None
    assert any(text.startswith("averaging_not_used") for text in told["warnings"])


@pytest.mark.parametrize("by", ["quaternions", "gyros"])
def test_a_later_session_is_averaged_as_the_set_in_force_was(by):
    """Without it the session would differ by the loss that the set does not have."""
    samples, later = spinning(), spinning(seed=4)
    gyro = ()
    if by == "gyros":
        samples, later = (replace(one, q_base_gcrf=None) for one in (samples, later))
        gyro = ("wx", "wy", "wz")
    record = calibrate(samples, [orbit()], integration_s=1.0, gyro=gyro, **PLAIN).to_dict()
    assert record["averaging"]["rate_from"] == by
    assert monitor(later, [orbit()], record).grade == "agrees"
    record["provenance"]["options"]["integration_s"] = None
    assert monitor(later, [orbit()], record).grade != "agrees"


def test_an_integration_time_that_cannot_be_is_refused():
    for time_s in (-1.0, 61.0, True):
        with pytest.raises(OptionError, match="integration_s"):
            CalibrationOptions(integration_s=time_s)
