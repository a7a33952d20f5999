"""Regressors: what unseen blocks support enters, what they do not stays out."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.terms.regressor_selection import ablation_of, usable_columns
from magcal_core.calibration.uncertainty.cross_validation import folds_of, held_out_residuals_nt
from magcal_core.errors import OptionError
from magcal_core.observations import Observations
from magcal_core.pipeline import calibrate
from magcal_core.telemetry import read_samples

PLAIN = FitSettings()
SLOPE_NT_PER_K = np.array([40.0, -25.0, 15.0])


@pytest.fixture(scope="module")
def warm(mission):
    """A bias that follows the temperature, beside columns that mean nothing."""
    flown = mission(n=1150, noise_nt=60.0)
    rng = np.random.default_rng(5)
    minute = np.arange(1150) / 6.0
    temperature = 20 + 12 * np.sin(2 * np.pi * minute / 94.0) + 3 * np.sin(2 * np.pi * minute / 31.0)
    columns = {
        "temperature": temperature,
        "noise": rng.normal(size=1150),
        "slow": np.cumsum(rng.normal(size=1150)),
        "constant": np.full(1150, 3.0),
    }
    h = flown.samples.h_nt + temperature[:, None] * SLOPE_NT_PER_K
    return replace(flown.samples, h_nt=h, housekeeping=columns), flown.truth


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_planted_temperature_coefficient_is_found(warm, method):
    """Within four formal standard errors of the planted slopes and bias at zero."""
    samples, truth = warm
    got = ESTIMATORS[method].fit(Observations.of(samples, ["temperature"]), PLAIN)
    errors = got.formal_standard_errors
    off = (got.parameters.regressors["temperature"] - SLOPE_NT_PER_K) / errors.regressors["temperature"]
    assert np.abs(off).max() < 4
    assert np.abs((got.parameters.vector[:9] - truth) / errors.vector[:9]).max() < 4


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_auto_takes_the_temperature_and_nothing_else(warm, method):
    got = calibrate(warm[0], method=method, regressors="auto")
    assert list(got.parameters.regressors) == ["temperature"]
    rows = got.to_dict()["ablation"]
    assert [row["regressors"] for row in rows if row["selected"]] == [["temperature"]]
    assert rows[0]["regressors"] == []
    assert got.cross_validated_rms_nt < 0.5 * rows[0]["cross_validated_rms_nt"]


def test_auto_takes_nothing_where_there_is_nothing(mission):
    """Of six columns that say nothing one is refitted, to be sure: none of the others promises anything."""
    rng = np.random.default_rng(2)
    samples = replace(mission().samples, housekeeping={f"c{i}": np.cumsum(rng.normal(size=700)) for i in range(6)})
    got = calibrate(samples, regressors="auto")
    assert not got.parameters.regressors
    assert got.parameters.vector.size == 9
    assert [len(row["regressors"]) for row in got.to_dict()["ablation"]] == [0, 1]


def test_columns_with_gaps_and_constant_columns_are_no_candidates(warm):
    samples, _ = warm
    gappy = samples.housekeeping["noise"].copy()
    gappy[::10] = np.nan
    found = usable_columns(dict(samples.housekeeping) | {"gappy": gappy}, np.ones(1150, dtype=bool))
    assert found == ("temperature", "noise", "slow")


def test_samples_without_a_value_of_a_regressor_are_left_out(warm):
    samples, _ = warm
    temperature = samples.housekeeping["temperature"].copy()
    temperature[:7] = np.nan
    got = calibrate(replace(samples, housekeeping={"temperature": temperature}), regressors=("temperature",))
    assert got.rejected == 7


def test_time_is_a_regressor_in_hours_since_the_first_sample(mission):
    flown = mission(n=1150, noise_nt=60.0)
    hours = np.arange(1150) * 10.0 / 3600.0
    samples = replace(flown.samples, h_nt=flown.samples.h_nt + hours[:, None] * [0.0, 100.0, 0.0])
    got = calibrate(samples, regressors=("time",))
    slope, error = got.parameters.regressors["time"], got.formal_standard_errors.regressors["time"]
    assert np.abs((slope - [0.0, 100.0, 0.0]) / error).max() < 4


@pytest.mark.parametrize("name", ["missing", "constant"])
def test_column_that_cannot_be_a_regressor_is_refused(warm, name):
    with pytest.raises(OptionError, match=name):
        calibrate(warm[0], regressors=(name,))


def test_held_out_residuals_are_those_of_fits_without_the_block(mission):
    observations = Observations.of(mission(n=300).samples)
    estimator = ESTIMATORS["scalar"]
    fit = estimator.fit(observations, PLAIN)
    got = held_out_residuals_nt(estimator, observations, PLAIN, fit)
    fold = folds_of(observations.t_s)[2]
    rest = np.setdiff1d(np.arange(300), np.arange(300)[fold])
    other = estimator.fit(observations.take(rest), PLAIN).parameters
    x = (observations.h_nt[fold] - other.bias_nt) @ np.linalg.inv(_matrix(other)).T
    np.testing.assert_allclose(got[fold], np.linalg.norm(x, axis=1) - observations.b_nt[fold], atol=1e-5)


def _matrix(parameters):
    s, c = np.sin(np.deg2rad(parameters.nonorthogonality_deg)), np.cos(np.deg2rad(parameters.nonorthogonality_deg))
    return np.diag(parameters.scale) @ [[1, 0, 0], [s[0], c[0], 0], [s[1], c[1] * s[2], c[1] * c[2]]]


def test_ablation_of_named_terms_compares_with_none(warm):
    observations = Observations.of(warm[0], ["temperature"])
    plain, chosen = ablation_of(ESTIMATORS["scalar"], observations, PLAIN, [(), ("temperature",)])
    assert (plain.is_selected, chosen.is_selected) == (False, True)
    assert chosen.cross_validated_rms_nt < plain.cross_validated_rms_nt


def test_hooke_jeeves_and_closed_form_take_none(warm):
    for method in ("scalar-hooke-jeeves", "vector-closed-form"):
        with pytest.raises(OptionError, match="regressors"):
            calibrate(warm[0], method=method, regressors=("temperature",))


@pytest.mark.real_data
def test_bro4_is_told_by_its_sun_sensors_on_unseen_blocks(bro4_dir):
    """Six contiguous blocks: 247 nT without regressors, an expert's choice of eight terms 175 nT."""
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
    reference = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}
    samples = read_samples(bro4_dir / "external.csv", columns=columns | reference, unit="mG")
    got = calibrate(samples, regressors="auto", robust="none")
    assert got.extras["ablation"][0]["cross_validated_rms_nt"] == pytest.approx(247, abs=1)
    assert got.cross_validated_rms_nt <= 176


@pytest.mark.real_data
def test_bro4_external_leaves_little_on_unseen_blocks_by_default(bro4_dir):
    """At most 110 nT with the columns that are there; the reference of the table is no regressor, nor the Sun's."""
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
    reference = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}
    got = calibrate(read_samples(bro4_dir / "external.csv", columns=columns | reference, unit="mG"), regressors="auto")
    assert got.cross_validated_rms_nt <= 110
    assert got.extras["data_quality"]["rejected_share"] < 0.08


@pytest.mark.real_data
def test_bro4_over_fitted_sun_sensors_are_seen_as_such(bro4_dir):
    """Six sums of four photodiodes: 95.1 nT in the fit, 389 nT on unseen blocks."""
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
    reference = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}
    samples = read_samples(bro4_dir / "external.csv", columns=columns | reference, unit="mG")
    diodes = [samples.housekeeping[f"fss_raw_{i}"] for i in range(24)]
    sums = {f"sun_{k}": np.sum(diodes[4 * k : 4 * k + 4], axis=0) for k in range(6)}
    got = calibrate(replace(samples, housekeeping=sums), regressors=tuple(sums), robust="none")
    assert got.after.rms_nt == pytest.approx(95.1, abs=0.1)
    assert got.cross_validated_rms_nt == pytest.approx(389, abs=1)
    assert got.verdict.grade != "accept"
