"""A third of the rows may be anything: the calibration is what it is without them, or is refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import EstimationError
from magcal_core.pipeline import calibrate
from tests.magcal_core.conftest import fly
from tests.magcal_core.fresh import fresh
from tests.magcal_core.garbage import KINDS, spoiled

SHARES = (0.003, 0.05, 0.2, 0.3)
FIELD_NT = 35000.0


def worst_error(calibration, mission, is_vector):
    """Largest error of the corrected field over the sphere, as a share of the field."""
    u = np.random.default_rng(0).normal(size=(300, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    h = mission.sensor.apply(FIELD_NT * u)
    x = (h - calibration.parameters.bias_nt) @ calibration.correction_matrix.T
    error = np.linalg.norm(x - FIELD_NT * u, axis=1) if is_vector else np.abs(np.linalg.norm(x, axis=1) - FIELD_NT)
    return float(error.max()) / FIELD_NT


@pytest.fixture(scope="module")
def missions():
    rng = np.random.default_rng(20261130)
    sensors = [
        type(fly().sensor)(rng.uniform(-20000, 20000, 3), rng.uniform(0.9, 1.1, 3), rng.uniform(-4, 4, 3))
        for _ in range(4)
    ]
    return [fly(noise_nt=60.0, seed=int(rng.integers(1 << 30)), sensor=one) for one in sensors]


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_with_bad_rows_is_calibrated_as_if_they_were_not_there(kind, missions):
    """Within 0.5 % of |B| in the worst direction; 95 % of the bad rows kept out, 1 % of the good ones lost at most.

    Of |B| alone a row is bad where its length is off by more than six times the noise: a spike across the field, or
    an axis that is stuck near its true value, is no bad row.
    """
    for seed, (share, mission) in enumerate(zip(SHARES, missions, strict=True)):
        samples, is_bad = spoiled(mission, kind, share, seed)
        got = calibrate(samples)
        assert worst_error(got, mission, is_vector=False) <= 0.005, (kind, share)
        assert got.verdict.grade in ("accept", "weak"), got.verdict.to_dict()
        weight = got.residuals.weight
        x = (samples.h_nt - mission.sensor.bias_nt) @ mission.sensor.correction_matrix.T
        is_seen = is_bad & (np.abs(np.linalg.norm(x, axis=1) - samples.b_ref_magnitude_nt) > 6 * 60.0)
        assert np.count_nonzero(weight[is_seen] == 0) >= 0.95 * is_seen.sum(), (kind, share)
        assert np.mean(weight[~is_bad] == 0) <= 0.01, (kind, share)
        quality = got.extras["data_quality"]
        assert quality["rows"] == 700
        assert quality["used"] == int(np.count_nonzero(weight > 0))
        assert quality["used"] + quality["rejected"] + sum(quality["flagged"].values()) == 700


@pytest.mark.parametrize("method", [name for name in ESTIMATORS if name != "scalar"])
@pytest.mark.parametrize("kind", ["zeros", "spikes of 200 uT", "axes swapped", "two sensors interleaved"])
def test_every_method_survives_a_third_of_bad_rows(method, kind, missions):
    samples, _ = spoiled(missions[0], kind, 0.3, 5)
    got = calibrate(samples, method=method)
    assert worst_error(got, missions[0], is_vector=method.startswith("vector")) <= 0.005
    assert got.verdict.grade in ("accept", "weak"), got.verdict.to_dict()


@pytest.mark.parametrize("method", ESTIMATORS)
def test_clean_data_give_the_plain_fit_bit_for_bit(method, missions):
    got, want = (
        calibrate(missions[1].samples, method=method),
        calibrate(missions[1].samples, method=method, robust="none"),
    )
    assert got.parameters.vector.tobytes() == want.parameters.vector.tobytes()
    assert got.covariance.tobytes() == want.covariance.tobytes()
    assert got.extras["robust"]["used"] == "none"
    assert got.extras["robust"]["start"] == "plain"


@pytest.mark.parametrize("kind", ["spikes of 10 uT", "axis inverted", "random numbers"])
def test_more_bad_rows_than_good_ones_are_never_accepted(kind, missions):
    for share in (0.55, 0.7):
        samples, _ = spoiled(missions[2], kind, share, 11)
        try:
            got = calibrate(samples)
        except EstimationError:
            continue
        assert got.verdict.grade != "accept" or worst_error(got, missions[2], is_vector=False) <= 0.005


def test_the_record_says_what_was_used_and_where_it_began(missions):
    samples, _ = spoiled(missions[0], "stretch with an offset", 0.2, 3)
    robust = calibrate(samples).extras["robust"]
    assert (robust["asked"], robust["used"], robust["start"]) == ("auto", "tukey", "lts")
    assert robust["scale_nt"] == pytest.approx(60.0, rel=0.15)
    assert robust["inlier_share"] == pytest.approx(0.8, abs=0.02)
    named = calibrate(samples, robust="cauchy")
    assert named.extras["robust"]["used"] == "cauchy"
    assert named.extras["robust"]["start"] == "lts"
    assert named.after.rms_nt < 100.0, "statistics are those of the rows that count"
    assert not [code for code in named.verdict.reasons if code.code == "large_residual"]


def test_outliers_are_warned_of_only_where_no_loss_was_asked_for(missions):
    samples, _ = spoiled(missions[0], "spikes of 3 uT", 0.02, 3)
    assert not [one for one in calibrate(samples).warnings if one.startswith("outliers")]
    assert [one for one in calibrate(samples, robust="none").warnings if one.startswith("outliers")]


def test_rows_without_a_reading_are_told_and_weaken_from_one_half(missions):
    few, _ = spoiled(missions[0], "zeros", 0.05, 3)
    got = calibrate(few)
    assert [one for one in got.warnings if one.startswith("rows_without_reading: 35 of 700 rows")]
    assert got.verdict.grade == "accept"
    many, _ = spoiled(missions[0], "zeros", 0.55, 3)
    found = calibrate(many).verdict
    assert found.grade == "weak"
    assert "rows_without_reading" in [reason.code for reason in found.reasons]


def test_a_saturated_sensor_is_told_and_its_rows_are_left_out(missions):
    samples, is_bad = spoiled(missions[3], "clipped", 0.1, 3)
    got = calibrate(samples)
    assert got.extras["data_quality"]["flagged"]["saturated"] == is_bad.sum()
    assert [one for one in got.warnings if one.startswith("saturated: ")]


@pytest.mark.parametrize(
    ("kind", "share", "method", "seed"),
    [("axis stuck", 0.3, "scalar", 209502), ("spikes of 200 uT", 0.05, "vector", 206201)],
)
def test_what_bad_rows_leave_is_no_matter_of_the_clock(kind, share, method, seed):
    """Their residual falls to a fifth at some hour or other, whatever the clock: no suspicion, and no refusal."""
    flown = fresh(seed)
    samples, _ = spoiled(flown, kind, share, seed)
    found = calibrate(flown.sent(samples, is_vector=method == "vector"), [flown.orbit], method=method)
    assert found.verdict.grade != "refuse"
    assert not found.extras["suspicions"]


def test_a_clock_that_is_hours_off_is_found_beside_bad_rows():
    flown = fresh(700004)
    samples, _ = spoiled(flown, "spikes of 10 uT", 0.2, 1)
    late = replace(samples, t_utc=samples.t_utc + np.timedelta64(7200, "s"))
    found = calibrate(flown.sent(late), [flown.orbit], time_offset="estimate")
    assert found.parameters.time_offset_s == pytest.approx(-7200.0, abs=1.5)
