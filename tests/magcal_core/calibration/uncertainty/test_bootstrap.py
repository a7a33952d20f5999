"""The bootstrap by steps: what a refit of every replicate gives, where steps suffice and where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.uncertainty.bootstrap import bootstrap
from magcal_core.errors import EstimationError
from magcal_core.observations import Observations

REPLICATES = 60


def refits(estimator, observations, settings, near, *, in_a_row, seed):
    """Refit every replicate that `bootstrap` draws; shape (replicates, p)."""
    n, starts = len(observations), near.blocks.starts
    cells = len(starts)
    first = np.random.default_rng(seed).integers(0, cells, (REPLICATES, round(cells / in_a_row)))
    found = []
    for blocks in first:
        counts = np.zeros(n)
        for block in blocks:
            for cell in range(block, block + in_a_row):
                begin = starts[cell % cells]
                counts[begin : starts[cell % cells + 1] if cell % cells + 1 < cells else n] += 1.0
        found.append(estimator.refit(replace(observations, weights=counts), settings, near).vector)
    return np.array(found)


def with_wave(samples, size_nt):
    """Return ``samples`` with a bias that goes round once an orbit."""
    phase = 2 * np.pi * 10.0 * np.arange(len(samples)) / 5640.0
    return replace(samples, h_nt=samples.h_nt + size_nt * np.sin(phase)[:, None] * [1.0, -0.7, 0.5])


@pytest.mark.parametrize(
    ("method", "settings", "wave_nt"),
    [
        ("scalar", FitSettings(), 0.0),
        ("scalar", FitSettings(noise_model="white"), 0.0),
        ("scalar", FitSettings("soft_l1"), 0.0),
        ("scalar", FitSettings("tukey"), 300.0),
        ("scalar-hooke-jeeves", FitSettings(), 0.0),
        ("vector", FitSettings(), 300.0),
        ("vector", FitSettings("huber"), 0.0),
        ("vector", FitSettings("tukey"), 300.0),
        ("vector-closed-form", FitSettings(), 0.0),
    ],
)
def test_steps_scatter_as_refits_do(mission, method, settings, wave_nt):
    """The same draws: to a tenth, for steps are let stand where the farthest three are a tenth of an error from refits.

    300 nT of a wave under a redescending loss: there the steps lead elsewhere, and refits take their place.
    """
    observations = Observations.of(with_wave(mission(n=700).samples, wave_nt))
    estimator = ESTIMATORS[method]
    near = estimator.fit(observations, settings)
    slow = refits(estimator, observations, settings, near, in_a_row=2, seed=5)
    got = bootstrap(estimator, observations, settings, near, 16, REPLICATES, seed=5)
    assert (got.block_samples, got.failed) == (16, 0)
    np.testing.assert_allclose(got.standard_errors.vector, slow.std(axis=0, ddof=1), rtol=0.1)
    spread = slow.std(axis=0, ddof=1)
    assert np.abs((got.low.vector - np.quantile(slow, 0.025, axis=0)) / spread).max() < 0.25
    assert np.abs((got.high.vector - np.quantile(slow, 0.975, axis=0)) / spread).max() < 0.25


def test_regressors_and_a_clock_that_stays_leave_the_steps_right(mission):
    """A fit with an offset among its unknowns: the replicates know the regressor's slopes and no offset."""
    samples = mission(n=700, noise_nt=60.0).samples
    slow = np.sin(np.arange(700) / 50.0)
    samples = replace(samples, housekeeping={"slow": slow}, h_nt=samples.h_nt + np.outer(slow, [200.0, -90.0, 40.0]))
    still = Observations.of(samples, ["slow"])
    moving = replace(still, rate_nt_s=20.0 * np.cos(np.arange(700) / 90.0)[:, None])
    estimator = ESTIMATORS["scalar"]
    near = estimator.fit(moving, FitSettings())
    assert near.clock.size == 1
    expected = refits(estimator, still, FitSettings(), near, in_a_row=2, seed=2).std(axis=0, ddof=1)
    got = bootstrap(estimator, moving, FitSettings(), near, 16, REPLICATES, seed=2)
    assert got.standard_errors.names == still_names(near)
    np.testing.assert_allclose(got.standard_errors.vector, expected, rtol=0.1)


def still_names(near):
    return tuple(name for name in near.parameters.names if name != "time_offset_s")


def plane_first(mission):
    """Return 400 observations by component, the first 300 of them with the field in a plane."""
    flown = mission(n=400, noise_nt=30.0)
    b_nt = flown.samples.b_ref_base_nt.copy()
    b_nt[:300, 2] = 0.0
    h_nt = flown.sensor.apply(b_nt) + np.random.default_rng(1).normal(0.0, 30.0, b_nt.shape)
    magnitude_nt = np.linalg.norm(b_nt, axis=1)
    return Observations.of(replace(flown.samples, h_nt=h_nt, b_ref_base_nt=b_nt, b_ref_magnitude_nt=magnitude_nt))


def test_replicates_that_determine_nothing_are_counted(mission):
    """Four blocks of 96 samples each: where all lie in the plane, a sixteenth of the draws, no third axis shows."""
    observations, estimator = plane_first(mission), ESTIMATORS["vector"]
    near = estimator.fit(observations, FitSettings())
    got = bootstrap(estimator, observations, FitSettings(), near, 96, REPLICATES, seed=1)
    assert 1 <= got.failed <= 12
    assert np.all(got.standard_errors.vector > 0)


def test_replicates_none_of_which_determines_anything_are_refused(mission):
    observations, estimator = plane_first(mission), ESTIMATORS["vector"]
    near = estimator.fit(observations, FitSettings())
    plane = replace(observations, weights=(np.arange(400) < 300).astype(float))
    with pytest.raises(EstimationError, match="none of 20 replicates"):
        bootstrap(estimator, plane, FitSettings(), near, 8, 20, seed=1)
