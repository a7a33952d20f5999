"""Blocks left out of long sessions: one step away, and what refits of every block give."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.uncertainty.cross_validation import folds_of, held_out_residuals_nt
from magcal_core.observations import Observations, residuals_nt

MANY = 40_000


def long_session(mission, wave_nt=0.0):
    """Return observations with a bias that goes round once an orbit of 570 samples, and twice in the whole session."""
    samples = mission(n=MANY, noise_nt=60.0).samples
    turn = 2 * np.pi * np.arange(MANY)
    wave = np.sin(turn / 570.0) + np.sin(2 * turn / MANY)
    return Observations.of(replace(samples, h_nt=samples.h_nt + wave_nt * wave[:, None] * [1.0, -0.7, 0.5]))


def refitted(estimator, observations, settings, near, fold):
    weights = observations.weights.copy()
    weights[fold] = 0.0
    found = estimator.refit(replace(observations, weights=weights), settings, near)
    return residuals_nt(observations.take(fold), found, estimator.is_vector)


@pytest.mark.parametrize(
    ("method", "robust", "wave_nt"),
    [
        ("scalar", "none", 0.0),
        ("scalar", "tukey", 300.0),
        ("scalar-hooke-jeeves", "none", 100.0),
        ("vector", "huber", 100.0),
        ("vector-closed-form", "none", 100.0),
    ],
)
def test_a_step_leaves_each_block_what_a_refit_leaves_it(mission, method, robust, wave_nt):
    """The RMS of every block to 1e-3, at which a step is let stand; what the block adds by being unseen is less."""
    observations, settings, estimator = long_session(mission, wave_nt), FitSettings(robust), ESTIMATORS[method]
    near = estimator.fit(observations, settings)
    got = held_out_residuals_nt(estimator, observations, settings, near)
    assert got is not None
    for fold in folds_of(observations.t_s):
        used = near.weights[fold] > 0
        expected = refitted(estimator, observations, settings, near, fold)[used]
        assert np.linalg.norm(got[fold][used]) == pytest.approx(np.linalg.norm(expected), rel=1e-3)


def test_a_block_that_alone_determines_an_axis_cannot_be_left_out(mission):
    """The field leaves its plane in the last sixth only: without it the third axis is unknown, and so is the RMS."""
    flown = mission(n=MANY, noise_nt=30.0)
    b_nt = flown.samples.b_ref_base_nt.copy()
    b_nt[: 5 * MANY // 6, 2] = 0.0
    h_nt = flown.sensor.apply(b_nt) + np.random.default_rng(1).normal(0.0, 30.0, b_nt.shape)
    magnitude_nt = np.linalg.norm(b_nt, axis=1)
    samples = replace(flown.samples, h_nt=h_nt, b_ref_base_nt=b_nt, b_ref_magnitude_nt=magnitude_nt)
    observations, estimator = Observations.of(samples), ESTIMATORS["vector"]
    near = estimator.fit(observations, FitSettings())
    assert held_out_residuals_nt(estimator, observations, FitSettings(), near) is None
