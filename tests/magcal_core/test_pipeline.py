"""The way from telemetry to a parameter set: worked cases, real telemetry, order, options and the record."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import (
    FrameError,
    NotObservableError,
    OptionError,
    OrbitMissingError,
    TleEpochError,
    TooManyBadSamplesError,
)
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.samples import SampleFlag
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, simulate
from magcal_core.telemetry import read_samples

BRO4_COLUMNS = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
BRO4_REFERENCE = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}


PLAIN = {
    "robust": "none",
    "noise_model": "none",
    "time_offset": "none",
    "locked_terms": "none",
    "bias_steps": "none",
}
"""The plain fit, to the rows as they came: that of published figures."""


@pytest.fixture(scope="module")
def nominal(data_dir):
    return read_samples(data_dir / "calibration" / "nominal.csv")


def flat(document):
    if isinstance(document, dict):
        return [leaf for value in document.values() for leaf in flat(value)]
    if isinstance(document, list):
        return [leaf for value in document for leaf in flat(value)]
    return [document]


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("name", ["nominal", "outliers"])
def test_worked_case_comes_out_of_the_record(data_dir, name, method):
    """The same minimiser, deterministic: 1e-6 of max(1, |answer|); the search 1e-4."""
    folder = data_dir / "calibration"
    expected = json.loads((folder / f"{name}.answer.json").read_text())["expected"]
    record = calibrate(read_samples(folder / f"{name}.csv"), method=method, **PLAIN).to_dict()
    key = {"scalar": "scalar_lm", "scalar-hooke-jeeves": "scalar_lm", "vector": "forward_ml"}.get(method, "ols_inverse")
    rel = 1e-4 if method == "scalar-hooke-jeeves" else 1e-6
    for mine, theirs in (("scale", "k"), ("nonorthogonality_deg", "eps_deg"), ("bias_nt", "b_nT")):
        for got, want in zip(record["parameters"][mine], expected[key][theirs], strict=True):
            assert abs(got - want) <= rel * max(1.0, abs(want))
    if method.startswith("scalar"):
        after, n = record["statistics"]["after"]["rms_nt"], record["statistics"]["samples"]
        assert after * math.sqrt(n) == pytest.approx(expected["scalar_lm"]["phi"], rel=1e-6)


@pytest.mark.parametrize("method", ESTIMATORS)
def test_record_is_json_with_the_fields_of_the_service(nominal, method):
    calibration = calibrate(nominal, method=method)
    record = json.loads(json.dumps(calibration.to_dict(), allow_nan=False))
    assert record["parameter_names"][:9] == [
        f"{group}[{i}]" for group in ("bias_nt", "scale", "nonorthogonality_deg") for i in range(3)
    ]
    assert np.shape(record["covariance"]) == (9, 9)
    product = np.array(record["matrix"]) @ record["correction_matrix"]
    np.testing.assert_allclose(product, np.eye(3), atol=1e-12)
    assert record["verdict"]["grade"] == "accept"
    assert len(record["candidates"]) == (4 if method == "vector-closed-form" else 0)
    assert record["data_from"] == "2022-02-19T22:37:44.130000Z"
    assert ("first_order" in record) == (method == "scalar-hooke-jeeves")
    assert all(math.isfinite(x) for x in flat(record) if isinstance(x, float))


@pytest.mark.parametrize("method", ESTIMATORS)
def test_result_does_not_depend_on_the_order_of_the_samples(nominal, method):
    """Bit for bit: the samples are sorted before anything is computed."""
    shuffled = nominal.take(np.random.default_rng(4).permutation(len(nominal)))
    assert calibrate(shuffled, method=method).to_dict() == calibrate(nominal, method=method).to_dict()


def test_progress_rises_from_zero_to_one(nominal):
    told = []
    calibrate(nominal, progress=told.append)
    assert told[0] == 0.0
    assert told[-1] == 1.0
    assert told == sorted(told)


def test_readings_that_are_not_finite_are_flagged_and_left_out(nominal):
    h = nominal.h_nt.copy()
    h[[3, 70]] = np.nan
    calibration = calibrate(replace(nominal, h_nt=h))
    assert calibration.rejected == 2
    assert calibration.samples == 573
    assert np.flatnonzero(calibration.residuals.flags & SampleFlag.NOT_FINITE).tolist() == [3, 70]
    assert np.flatnonzero(calibration.residuals.weight == 0).tolist() == [3, 70]
    h[:300] = np.inf
    with pytest.raises(TooManyBadSamplesError):
        calibrate(replace(nominal, h_nt=h))


@pytest.mark.parametrize("turn_deg", [5.0, 8.0])
def test_the_closed_form_refuses_a_reference_in_a_turned_frame(nominal, turn_deg):
    turn = np.deg2rad(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    got = calibrate(replace(nominal, b_ref_base_nt=nominal.b_ref_base_nt @ rotation), method="vector-closed-form")
    assert got.verdict.grade == "refuse"
    assert "misaligned" in [reason.code for reason in got.verdict.reasons]
    assert got.extras["full_matrix"]["rotation_deg"] == pytest.approx(turn_deg, abs=0.1)


def test_a_reference_in_a_turned_frame_gives_the_full_matrix(nominal):
    """T = T_low R: the matrix has the turn, scale and angles are those of T_low, and a warning says so."""
    turn = np.deg2rad(8.0)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    straight = calibrate(nominal, method="vector")
    got = calibrate(replace(nominal, b_ref_base_nt=nominal.b_ref_base_nt @ rotation), method="vector")
    assert (straight.extras["parameters_of"], got.extras["parameters_of"]) == ("lower", "full")
    assert got.verdict.grade == "accept"
    assert [one for one in got.warnings if one.startswith("misaligned")]
    assert got.to_dict()["bias_steps"]["state"] == "not_searched", "what turns is no step of nine parameters' bias"
    np.testing.assert_allclose(got.matrix, straight.matrix @ rotation, atol=1e-3)
    np.testing.assert_allclose(got.parameters.scale, straight.parameters.scale, atol=1e-3)
    errors = np.array(got.extras["matrix_standard_errors"])
    assert np.all(errors > 0)
    assert not np.triu(straight.extras["matrix_standard_errors"], 1).any()
    covariance = np.array(got.extras["covariance_full"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[[0, 1, 2]], errors[0])
    np.testing.assert_allclose(got.matrix @ got.correction_matrix, np.eye(3), atol=1e-12)


def test_samples_without_a_reference_need_an_orbit(nominal):
    bare = replace(nominal, b_ref_base_nt=None, b_ref_magnitude_nt=None)
    with pytest.raises(OrbitMissingError):
        calibrate(bare)


def test_too_few_samples_are_refused_with_the_parameters_named(nominal):
    with pytest.raises(NotObservableError, match="5 usable samples"):
        calibrate(nominal.take(slice(0, 5)))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("method", "magic"),
        ("method", 3),
        ("field", "wmm-1900"),
        ("field_max_degree", 0),
        ("field_max_degree", 9.5),
        ("orbit", "kepler"),
        ("time_offset", True),
        ("time_drift", 1),
        ("regressors", "temperature"),
        ("regressors", ("a", "a")),
        ("regressors", [1]),
        ("robust", "median"),
        ("noise_model", None),
        ("noise_nt", 0.0),
        ("noise_nt", float("nan")),
        ("max_orbit_age_days", "14"),
        ("max_orbit_age_days", True),
        ("bootstrap", -1),
        ("unheard_of", 1),
    ],
)
def test_option_that_cannot_be_is_refused_by_name(name, value):
    with pytest.raises(OptionError) as caught:
        CalibrationOptions.from_dict({name: value})
    assert [fault.where for fault in caught.value.faults] == [name]


def test_options_round_trip():
    options = CalibrationOptions(method="vector", regressors=("temperature",), robust="tukey", noise_nt=50.0)
    assert CalibrationOptions.from_dict(options.to_dict()) == options
    assert CalibrationOptions.from_dict(json.loads(json.dumps(options.to_dict()))) == options


@pytest.fixture(scope="module")
def on_board(bro4_dir):
    samples = read_samples(bro4_dir / "external.csv", columns=BRO4_COLUMNS | BRO4_REFERENCE, unit="mG")
    return calibrate(samples, **PLAIN)


@pytest.fixture(scope="module")
def bare(bro4_dir):
    return read_samples(bro4_dir / "external.csv", columns=BRO4_COLUMNS, unit="mG")


@pytest.fixture(scope="module")
def tle(bro4_dir):
    return [Sgp4Orbit.from_tle((bro4_dir / "tle.txt").read_text())]


@pytest.fixture(scope="module")
def orbit(data_dir):
    return Sgp4Orbit(parse_tles((data_dir / "dekart.tle.txt").read_text())[0])


@pytest.mark.real_data
class TestBro4:
    """Figures of independent fits to the same telemetry."""

    def test_on_board_reference(self, on_board):
        assert on_board.before.rms_nt == pytest.approx(1367, abs=1)
        assert on_board.after.rms_nt == pytest.approx(181.5, abs=1)
        assert on_board.cross_validated_rms_nt == pytest.approx(247, abs=1)
        assert on_board.samples == 2371

    def test_honest_errors_are_many_times_the_formal_ones(self, on_board):
        """Formal 6-9 nT; block fits scatter by 90-300 nT."""
        assert on_board.formal_standard_errors.bias_nt.max() < 10
        assert on_board.standard_errors.bias_nt.max() > 40

    def test_stale_tle_without_offset(self, bare, tle):
        got = calibrate(bare, tle, max_orbit_age_days=60.0, **PLAIN)
        assert got.after.rms_nt == pytest.approx(423, abs=5)
        assert [w for w in got.warnings if w.startswith("tle_old")]
        assert got.verdict.grade == "refuse"

    def test_stale_tle_is_refused_unless_allowed(self, bare, tle):
        with pytest.raises(TleEpochError):
            calibrate(bare, tle)

    @pytest.mark.parametrize("method", ["scalar", "scalar-hooke-jeeves"])
    def test_stale_tle_with_its_offset_estimated(self, bare, tle, on_board, method):
        options = {**PLAIN, "time_offset": "estimate"}
        got = calibrate(bare, tle, max_orbit_age_days=60.0, method=method, **options)
        assert got.parameters.time_offset_s == pytest.approx(31, abs=1)
        assert got.after.rms_nt <= 195
        assert np.abs(got.parameters.bias_nt - on_board.parameters.bias_nt).max() <= 50
        assert np.shape(got.covariance) == (10, 10)

    @pytest.mark.parametrize("method", ["scalar", "scalar-hooke-jeeves"])
    def test_beside_locked_errors_the_offset_of_a_stale_tle_agrees_within_its_interval(
        self, bare, tle, on_board, method
    ):
        """The plain fit's 31 s, and the bias that the reference on board gives."""
        got = calibrate(bare, tle, max_orbit_age_days=60.0, method=method, robust="none")
        assert np.shape(got.covariance) == (10, 10)
        assert got.parameters.time_offset_s == pytest.approx(31.6, abs=1.96 * got.standard_errors.time_offset_s)
        assert got.standard_errors.time_offset_s < 5.0
        apart = np.abs(got.parameters.bias_nt - on_board.parameters.bias_nt)
        assert np.all(apart < 1.96 * np.hypot(got.standard_errors.bias_nt, on_board.standard_errors.bias_nt))


class TestPartOfTheAttitude:
    """A scalar fit needs no attitude: samples without one are in it all the same."""

    def flown(self, orbit, share):
        sensor = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])
        made = simulate(orbit, sensor, orbit.epoch_utc, 6000.0, 10.0, disturbances=Disturbances(noise_nt=30.0), seed=3)
        q = made.samples.q_base_gcrf.copy()
        q[: int(share * len(q))] = np.nan
        return replace(made.samples, q_base_gcrf=q)

    @pytest.mark.parametrize("time_offset", ["none", "estimate"])
    def test_samples_without_attitude_take_part_in_a_scalar_fit(self, orbit, time_offset):
        """Exactly the numbers of the same samples without any attitude."""
        part, none = self.flown(orbit, 0.2), replace(self.flown(orbit, 0.2), q_base_gcrf=None)
        got = calibrate(part, [orbit], time_offset=time_offset)
        want = calibrate(none, [orbit], time_offset=time_offset)
        assert got.samples == want.samples == 600
        np.testing.assert_allclose(got.parameters.vector, want.parameters.vector, rtol=1e-9)

    def test_the_mounting_is_resolved_by_the_samples_that_have_one(self, orbit):
        assert calibrate(self.flown(orbit, 0.2), [orbit]).extras["mounting"]["state"] == "resolved"

    def test_a_vector_fit_leaves_them_out(self, orbit):
        got = calibrate(self.flown(orbit, 0.2), [orbit], method="vector")
        assert (got.samples, got.rejected) == (480, 120)


def test_a_constant_field_is_accepted(orbit):
    """In a coil cage |B| does not vary: the mean residual is -sigma^2 / |B|, which belongs to the minimum."""
    made = simulate(orbit, SensorModel([2000, -1000, 500], [1.03, 1.01, 0.99], [-4, 1, 7]), orbit.epoch_utc, 6000, 10)
    direction = made.b_base_nt / np.linalg.norm(made.b_base_nt, axis=1, keepdims=True)
    noise = 100.0 * np.random.default_rng(4).normal(size=direction.shape)
    sensor = SensorModel([2000, -1000, 500], [1.03, 1.01, 0.99], [-4, 1, 7])
    h = sensor.apply(45000.0 * direction) + noise
    samples = replace(made.samples, h_nt=h, q_base_gcrf=None, b_ref_magnitude_nt=np.full(len(h), 45000.0))
    got = calibrate(samples)
    assert got.verdict.grade == "accept"
    np.testing.assert_allclose(got.parameters.vector[:3], sensor.bias_nt, atol=4 * got.standard_errors.bias_nt.max())


@pytest.mark.parametrize(
    ("counts_per_nt", "said"), [(0.125, True), (0.164, True), (0.5, False), (1.6, False), (4.0, True)]
)
def test_raw_counts_are_told_by_the_scale_that_they_leave(nominal, counts_per_nt, said):
    """Two usual counts a nT and a factor that no unit has: the numbers are sound, the verdict names what they scale."""
    found = calibrate(replace(nominal, h_nt=nominal.h_nt * counts_per_nt)).verdict
    assert (found.grade, found.reasons[0].code) == (("weak", "scale_far") if said else ("accept", "observable"))


def test_a_vector_fit_of_permuted_axes_names_the_right_ones(orbit):
    samples = simulate(orbit, SensorModel([0, 0, 0], [1, 1, 1], [0, 0, 0]), orbit.epoch_utc, 6000, 10).samples
    with pytest.raises(FrameError, match=r"seem to be \(z, x, y\)"):
        calibrate(replace(samples, h_nt=samples.h_nt[:, [1, 2, 0]]), [orbit], method="vector")


class TestTimeOffset:
    """Simulated passes with a clock offset planted: what must be added to the telemetry's clock."""

    def made(self, orbit, offset_s, days=0.0, seed=3, duration_s=11500.0):
        start = orbit.epoch_utc.astype("datetime64[s]") + np.timedelta64(round(days * 86400), "s")
        sensor = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])
        disturbances = Disturbances(noise_nt=50.0, time_offset_s=offset_s)
        return simulate(orbit, sensor, start, duration_s, 10.0, disturbances=disturbances, seed=seed)

    def flown(self, orbit, offset_s, days=0.0, seed=3):
        return self.made(orbit, offset_s, days, seed).samples

    @pytest.mark.parametrize("method", ["scalar", "vector"])
    @pytest.mark.parametrize("offset_s", [-20.0, 2.0])
    def test_planted_offset_is_found(self, orbit, method, offset_s):
        """Within four of its own standard errors; sign: what must be added to the telemetry's clock."""
        got = calibrate(self.flown(orbit, offset_s), [orbit], method=method, time_offset="estimate")
        error = got.standard_errors.time_offset_s
        assert error < (1.5 if method == "scalar" else 0.5)
        assert got.parameters.time_offset_s == pytest.approx(offset_s, abs=4 * error)
        assert got.extras["time_offset"]["is_significant"] is (abs(got.parameters.time_offset_s) > 2.2 * error)

    @pytest.mark.parametrize("days", [0.0, 5.0])
    def test_auto_finds_an_offset_whatever_the_age_of_the_orbit(self, orbit, days):
        """Of a fresh orbit 5 s are taken; of one that is 5 days off only what its own error does not explain."""
        offset_s = 5.0 if not days else 20.0
        got = calibrate(self.flown(orbit, offset_s, days=days), [orbit])
        assert got.parameters.time_offset_s == pytest.approx(offset_s, abs=4 * got.standard_errors.time_offset_s)
        assert got.extras["time_offset"]["is_taken"]
        left = calibrate(self.flown(orbit, 0.5, days=days), [orbit])
        assert left.parameters.time_offset_s is None
        assert not left.extras["time_offset"]["is_taken"]

    def test_a_clock_and_noise_that_moves_the_scale_factors_are_found_together(self, orbit):
        """3 uT of noise: the fit with noise in the reading keeps the clock that was taken before it."""
        start = orbit.epoch_utc.astype("datetime64[s]")
        sensor = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])
        disturbances = Disturbances(noise_nt=3000.0, time_offset_s=60.0)
        samples = simulate(orbit, sensor, start, 86000.0, 10.0, disturbances=disturbances, seed=11).samples
        got = calibrate(samples, [orbit], method="scalar", time_offset="estimate")
        assert got.extras["noise_model_used"] == "white"
        assert got.parameters.time_offset_s == pytest.approx(60.0, abs=4 * got.standard_errors.time_offset_s)
        assert np.abs(got.parameters.scale - sensor.scale) / got.standard_errors.scale == pytest.approx(0, abs=4)

    @pytest.mark.parametrize("offset_s", [300.0, -1000.0, 20000.0])
    def test_a_clock_that_is_far_off_is_suspected_unasked_and_taken_where_it_is_asked_for(self, orbit, offset_s):
        samples = replace(self.flown(orbit, offset_s), q_base_gcrf=None)
        asked = calibrate(samples, [orbit], time_offset="estimate")
        assert asked.parameters.time_offset_s == pytest.approx(offset_s, abs=4 * asked.standard_errors.time_offset_s)
        coarse = asked.extras["time_offset"]["coarse"]
        assert coarse["offset_s"] == pytest.approx(offset_s, abs=3.0)
        assert coarse["ratio_to_plain"] < 1.0 / 3.0 < 1.3 < coarse["next_ratio"]
        assert asked.verdict.grade == "accept"

    def test_auto_leaves_out_an_offset_that_the_data_do_not_show(self, orbit):
        got = calibrate(self.flown(orbit, 0.0, days=5.0), [orbit])
        assert got.parameters.time_offset_s is None
        (warning,) = [w for w in got.warnings if w.startswith("time_offset_not_used")]
        assert "s and more" in warning

    def test_the_result_says_which_offset_it_would_find(self, orbit):
        """Two-sided 3 % and a power of 95 %: 2.170 + 1.645 standard errors."""
        clock = calibrate(self.flown(orbit, 0.0), [orbit], time_offset="estimate").extras["time_offset"]
        assert clock["detectable_s"] == pytest.approx(3.815 * clock["standard_error_s"], rel=1e-3)

    def test_a_wave_of_the_orbit_is_told_and_does_not_widen_the_offset(self, orbit):
        """94 min and 150 nT over 3.2 h: told, and the offset's error stays within twice that without it.

        As an error with a memory, which it is where nobody names it, such a wave makes it three times as large.
        """
        start = orbit.epoch_utc.astype("datetime64[s]")
        sensor = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])
        waved = Disturbances(50.0, time_offset_s=1.0, wave_nt=(100.0, -80.0, 80.0), wave_period_s=5640.0)
        samples = simulate(orbit, sensor, start, 11500.0, 10.0, disturbances=waved, seed=3).samples
        got = calibrate(samples, [orbit], time_offset="estimate")
        assert [one for one in got.warnings if one.startswith("bias_locked")]
        clock = got.extras["time_offset"]
        quiet = calibrate(self.flown(orbit, 1.0), [orbit], time_offset="estimate")
        assert clock["standard_error_s"] < 2.0 * quiet.extras["time_offset"]["standard_error_s"]
        assert clock["offset_s"] == pytest.approx(1.0, abs=4 * clock["standard_error_s"])

    def test_a_wave_of_another_period_is_an_unknown_beside_the_offset(self, orbit):
        """40 min and 150 nT: no family has it, and its period is told to 10 %."""
        start = orbit.epoch_utc.astype("datetime64[s]")
        sensor = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])
        waved = Disturbances(50.0, time_offset_s=5.0, wave_nt=(100.0, -80.0, 80.0), wave_period_s=2400.0)
        samples = simulate(orbit, sensor, start, 11500.0, 10.0, disturbances=waved, seed=3).samples
        got = calibrate(samples, [orbit], time_offset="estimate")
        clock = got.extras["time_offset"]
        assert min(abs(period_s - 2400.0) for period_s in clock["wave_periods_s"]) < 240.0
        assert clock["offset_s"] == pytest.approx(5.0, abs=4 * clock["standard_error_s"])

    def test_planted_drift_is_found(self, orbit):
        """40 s a day over 3.2 h; within four standard errors."""
        samples = self.flown(orbit, 0.0)
        seconds = (samples.t_utc - samples.t_utc[0]) / np.timedelta64(1, "s")
        drift = np.round(seconds * 40.0 / 86400.0 * 1e9).astype("timedelta64[ns]")
        got = calibrate(replace(samples, t_utc=samples.t_utc - drift), [orbit], time_offset="estimate", time_drift=True)
        clock = got.extras["time_offset"]
        assert clock["drift_s_per_day"] == pytest.approx(40.0, abs=4 * clock["drift_standard_error_s_per_day"])

    def test_offset_of_a_reference_in_the_telemetry_is_refused(self, nominal):
        with pytest.raises(OptionError, match="no orbit"):
            calibrate(nominal, time_offset="estimate")

    def test_an_offset_that_a_regressor_explains_is_not_applied(self, orbit):
        """A current that moves axis 1 and 3 like a late clock: significant without its column, not beside it.

        Beside errors locked to the orbit it is not significant either way: the plain clock is what it deceives.
        """
        made = self.made(orbit, 0.0, days=5.0, seed=0, duration_s=6900.0)
        size_nt, axis = np.linalg.norm(made.b_base_nt, axis=1), np.array([0.6, 0.0, 0.8])
        current = np.gradient(size_nt) / 10.0 * (made.b_base_nt @ axis) / size_nt
        read = current + 0.3 * np.random.default_rng(0).normal(size=len(current))
        h_nt = made.samples.h_nt + 4.0 * current[:, None] * axis
        samples = replace(made.samples, h_nt=h_nt, housekeeping={"current": read})
        plain = calibrate(samples, [orbit], locked_terms="none")
        assert plain.parameters.time_offset_s == pytest.approx(1.16, abs=0.1)
        assert calibrate(samples, [orbit]).parameters.time_offset_s is None
        for locked_terms in ("none", "auto"):
            got = calibrate(samples, [orbit], regressors="auto", locked_terms=locked_terms)
            assert list(got.parameters.regressors) == ["current"]
            assert not got.extras["time_offset"]["is_significant"]
            assert got.parameters.time_offset_s is None
            assert [w for w in got.warnings if w.startswith("time_offset_not_used")]

    def test_an_offset_is_sought_again_beside_the_regressors(self, orbit):
        """3 uT of a heater that switches hide two seconds; beside its current they show, with half the error.

        They are told and not taken: after five days the orbit may be as far off along its track; six seconds are taken.
        """
        rng = np.random.default_rng(1000)
        flown = {offset_s: self.made(orbit, offset_s, days=5.0, seed=0, duration_s=6900.0) for offset_s in (2.0, 6.0)}
        count = len(flown[2.0].samples)
        current = 0.5 * (np.cumsum(rng.random(count) < 0.02) % 2) + 0.01 * rng.normal(size=count)
        moved_nt = current[:, None] * [2400.0, -1600.0, 1800.0]
        switched = {
            offset_s: replace(made.samples, h_nt=made.samples.h_nt + moved_nt, housekeeping={"heater_a": current})
            for offset_s, made in flown.items()
        }
        hidden = calibrate(switched[2.0], [orbit])
        assert hidden.parameters.time_offset_s is None
        assert not hidden.extras["time_offset"]["is_significant"]
        got = calibrate(switched[2.0], [orbit], regressors="auto")
        assert list(got.parameters.regressors) == ["heater_a"]
        clock = got.extras["time_offset"]
        assert clock["is_significant"]
        assert not clock["is_taken"]
        assert clock["offset_s"] == pytest.approx(2.0, abs=4 * clock["standard_error_s"])
        assert clock["standard_error_s"] < 0.6 * hidden.extras["time_offset"]["standard_error_s"]
        taken = calibrate(switched[6.0], [orbit], regressors="auto")
        assert list(taken.parameters.regressors) == ["heater_a"]
        assert taken.parameters.time_offset_s == pytest.approx(6.0, abs=4 * taken.standard_errors.time_offset_s)

    @pytest.mark.parametrize("method", ["scalar", "vector"])
    def test_some_seconds_are_told_from_nothing(self, orbit, method):
        """Eight passes each: a false offset in 3 %, at most one; 6 s of |B| and 2 s of components are missed by none.

        The errors have what 40 nT of external field do to the offset in them: 1.3 s of |B| over two orbits.
        """
        found, planted_s = {}, 6.0 if method == "scalar" else 2.0
        for offset_s in (0.0, planted_s):
            passes = [self.flown(orbit, offset_s, days=0.3 * seed, seed=seed) for seed in range(8)]
            results = [calibrate(one, [orbit], method=method, time_offset="estimate") for one in passes]
            found[offset_s] = sum(one.extras["time_offset"]["is_significant"] for one in results)
        assert found[0.0] <= 1
        assert found[planted_s] == 8
