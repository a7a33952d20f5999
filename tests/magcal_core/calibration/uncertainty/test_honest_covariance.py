"""Honest errors: intervals that cover under coloured errors, and what the white-noise ones miss."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t as student

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.uncertainty.bootstrap import bootstrap
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, honest_covariance, student_95
from magcal_core.calibration.verdict.assessment import Circumstances, judgement_of
from magcal_core.numerics.blocks import BlockScores
from magcal_core.observations import Observations
from magcal_core.telemetry import read_samples

PLAIN = FitSettings()


def errors_of(observations, method="scalar"):
    fit = ESTIMATORS[method].fit(observations, PLAIN)
    honest = honest_covariance(fit.blocks, fit.covariance, len(observations), covered_s(observations.t_s))
    return fit, np.sqrt(np.diag(honest.covariance))


@pytest.mark.parametrize("method", ["scalar", "vector"])
@pytest.mark.parametrize(
    ("error", "n"),
    [("white", 1150), ("wave", 1150), ("temperature", 1150), ("reference", 1150), ("random", 1150), ("random", 575)],
)
def test_intervals_cover_under_coloured_errors(mission, method, error, n):
    """40 missions x 9 parameters; 95 % intervals. The binomial scatter of correlated parameters is about 3 %.

    ``random``: a bias that remembers 30 minutes, in two orbits and in one.
    """
    covered, formally = [], []
    seconds = 10.0 * np.arange(n)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        flown = mission(n=n, noise_nt=60.0, seed=seed, rate_deg_s=rng.uniform(0.3, 1.2))
        h, b = flown.samples.h_nt.copy(), flown.samples.b_ref_base_nt
        if error == "wave":
            h[:, rng.integers(3)] += 250 * np.sin(2 * np.pi * seconds / 2400 + rng.uniform(0, 6.28))
        if error == "random":
            drive = rng.normal(size=(n, 3)) * 100 * np.sqrt(1 - np.exp(-2 / 180))
            drive[0] = 100 * rng.normal(size=3)
            h += lfilter([1.0], [1.0, -np.exp(-1 / 180)], drive, axis=0)
        if error == "temperature":
            h += rng.normal(size=3) * 150 * np.sin(2 * np.pi * seconds / 5640 + rng.uniform(0, 6.28))[:, None]
        if error == "reference":
            waves = [rng.normal() * np.sin(2 * np.pi * seconds * k / 5700 + rng.uniform(0, 6.28)) for k in range(1, 8)]
            b = b * (1 + 30 * np.sum(waves, axis=0) / np.linalg.norm(b, axis=1))[:, None]
        samples = replace(flown.samples, h_nt=h, b_ref_base_nt=b, b_ref_magnitude_nt=np.linalg.norm(b, axis=1))
        fit, honest = errors_of(Observations.of(samples), method)
        off = np.abs(fit.parameters.vector - flown.truth)
        covered.append(off < 1.96 * honest)
        formally.append(off < 1.96 * fit.formal_standard_errors.vector)
    assert np.mean(covered) > 0.90
    if error == "wave" and method == "scalar":
        assert np.mean(formally) < 0.85


def test_bootstrap_agrees_with_the_honest_errors(mission):
    """White noise, 300 replicates: to 45 % in the mean over parameters, none below it by more than the bootstrap's 5 %.

    The honest errors carry Student's t, the memory that so short a session may hide, and are never below the formal.
    """
    observations = Observations.of(mission(noise_nt=60.0).samples)
    fit, honest = errors_of(observations)
    found = bootstrap(ESTIMATORS["scalar"], observations, PLAIN, fit, 10, 300, seed=1)
    ratio = honest / found.standard_errors.vector
    assert np.exp(np.mean(np.log(ratio))) == pytest.approx(1.0, abs=0.45)
    assert ratio.min() > 0.95
    assert found.failed == 0
    assert np.all(found.low.vector < fit.parameters.vector)
    assert np.all(found.high.vector > fit.parameters.vector)


def test_bootstrap_repeats_with_its_seed(mission):
    observations = Observations.of(mission(n=200).samples)
    fit, _ = errors_of(observations)
    first, second = (bootstrap(ESTIMATORS["scalar"], observations, PLAIN, fit, 10, 20, seed=3) for _ in range(2))
    assert first.to_dict() == second.to_dict()


def test_time_covered_leaves_gaps_out():
    """Two runs of 1000 s at 10 s, a day apart: 2000 s and a few steps, each step being of 8 s to 10 s of samples."""
    run = np.arange(0.0, 1000.0, 10.0)
    assert covered_s(run) == pytest.approx(990.0)
    assert covered_s(np.concatenate([run, run + 86400.0])) == pytest.approx(1990.0, abs=40.0)
    assert covered_s(np.zeros(1)) == 0.0


def test_a_short_session_is_told_to_last_longer(mission):
    """Half an hour hides what remembers an orbit: the record says how long a memory was allowed for, and what helps."""
    told = {}
    for n in (180, 1150):
        observations = Observations.of(mission(n=n, noise_nt=60.0).samples)
        fit = ESTIMATORS["scalar"].fit(observations, PLAIN)
        told[n] = judgement_of(ESTIMATORS["scalar"], observations, fit, PLAIN, Circumstances(0.0, False, 0))
    assert any(line.startswith("measure for an orbit or more") for line in told[180].advice)
    assert not any(line.startswith("measure for an orbit or more") for line in told[1150].advice)
    assert told[180].honest.longest_memory_s == pytest.approx(6 * 1790.0)


def test_tabulated_student_quantiles():
    """Against scipy; three printed digits in the table, four by the series."""
    for freedom in [*range(1, 31), 60, 500]:
        assert student_95(freedom) == pytest.approx(student.ppf(0.975, freedom), rel=5e-4)


@pytest.mark.real_data
def test_bro4_halves_cover_each_other(bro4_dir):
    """Differences between complementary halves, in the errors of both: 95 % intervals over all splits tried."""
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
    reference = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}
    samples = read_samples(bro4_dir / "external.csv", columns=columns | reference, unit="mG")
    observations = Observations.of(samples)
    covered = []
    for count in (2, 4, 6, 8):
        parts = np.array_split(np.arange(len(observations)), count)
        for chosen in [c for c in combinations(range(count), count // 2) if 0 in c][:10]:
            one = np.concatenate([parts[i] for i in chosen])
            other = np.setdiff1d(np.arange(len(observations)), one)
            (first, e1), (second, e2) = errors_of(observations.take(one)), errors_of(observations.take(other))
            covered.append(np.abs(first.parameters.vector - second.parameters.vector) < 1.96 * np.hypot(e1, e2))
    assert np.mean(covered) > 0.90


def test_an_unknown_that_one_block_alone_shows_leaves_the_others_their_errors() -> None:
    random = np.random.default_rng(8)
    rows = random.normal(size=(20, 30, 2))
    normals, scores = np.zeros((20, 3, 3)), np.zeros((20, 3))
    normals[:, :2, :2] = np.einsum("kni,knj->kij", rows, rows)
    scores[:, :2] = np.einsum("kni,kn->ki", rows, random.normal(size=(20, 30)))
    normals[5, 2, 2] = 7.0
    starts = np.arange(20) * 30
    found = [
        honest_covariance(BlockScores(scores[:, :q], normals[:, :q, :q], starts, np.eye(q)), np.eye(q), 600, 6000.0)
        for q in (3, 2)
    ]
    np.testing.assert_allclose(found[0].covariance[:2, :2], found[1].covariance, rtol=1e-9)
