"""Bias and scatter of every estimator over noises: the bounded form of ``python -m benchmarks montecarlo``."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.observations import Observations

RUNS = 60


@pytest.mark.parametrize("method", sorted(ESTIMATORS))
def test_estimator_is_unbiased_and_efficient(mission, method):
    """60 runs: bias within 4 of its standard errors (36 tests), RMSE within 35 % of the bound (its scatter is 9 %)."""
    flown = mission(n=300, noise_nt=0.0)
    clean = Observations.of(flown.samples)
    random = np.random.default_rng(12)
    errors = np.empty((RUNS, 9))
    for i in range(RUNS):
        noisy = replace(clean, h_nt=clean.h_nt + 50.0 * random.normal(size=clean.h_nt.shape))
        errors[i] = ESTIMATORS[method].fit(noisy, FitSettings()).parameters.vector - flown.truth
    white = FitSettings(noise_model="white", noise_nt=50.0)
    reference = ESTIMATORS["vector" if ESTIMATORS[method].is_vector else "scalar"].fit(noisy, white)
    bound = reference.formal_standard_errors.vector * 50.0 / reference.sigma_nt
    assert np.abs(errors.mean(axis=0) / (errors.std(axis=0) / np.sqrt(RUNS))).max() < 4.0
    assert (np.sqrt(np.mean(errors**2, axis=0)) / bound).max() < 1.35


def test_noise_aware_fit_has_no_scale_bias_where_the_plain_one_has(mission):
    """Plain |B|: 2 sigma^2 / <B^2> = 0.6 % at 2000 nT; the noise-aware fit is free of it. 20,000 samples."""
    flown = mission(n=20000, noise_nt=2000.0)
    observations = Observations.of(flown.samples)
    plain = ESTIMATORS["scalar"].fit(observations, FitSettings())
    aware = ESTIMATORS["scalar"].fit(observations, FitSettings(noise_model="white"))
    relative = 2.0 * 2000.0**2 / np.mean(observations.b_nt**2)
    off = plain.parameters.scale / flown.sensor.scale - 1.0
    assert off.mean() == pytest.approx(relative, rel=0.3)
    error = aware.formal_standard_errors.scale / flown.sensor.scale
    assert np.abs((aware.parameters.scale / flown.sensor.scale - 1.0) / error).max() < 4.0
