"""Warnings of the residuals against planted noise and spikes."""

import re

import numpy as np
import pytest

import magcal_core as mc


def warned(result, code):
    return [warning for warning in result.warnings if warning.startswith(code)]


def test_noise_that_makes_the_scale_factors_too_large_is_told_with_its_size(mission):
    """1000 nT: 2 sigma^2 / <B^2> beforehand. The noise-aware fit of the same data differs by it to 10 %.

    Both have the same noise, so that their difference scatters little; the warning's sigma is that of the residuals,
    4 % below the noise in the mean direction, hence 10 % there too.
    """
    samples = mission(noise_nt=1000.0, n=20_000, seed=3).samples
    plain, aware = (mc.calibrate(samples, noise_model=model) for model in ("none", "white"))
    predicted_ppm = 2e6 * 1000.0**2 / np.mean(samples.b_ref_magnitude_nt**2)
    shift_ppm = 1e6 * np.mean(plain.parameters.scale / aware.parameters.scale - 1.0)
    assert shift_ppm == pytest.approx(predicted_ppm, rel=0.1)
    (told,) = warned(plain, "noise_in_scale")
    assert float(re.search(r"(\d+) ppm", told)[1]) == pytest.approx(predicted_ppm, rel=0.1)
    assert not warned(aware, "noise_in_scale")


def test_noise_too_small_to_matter_is_not_warned_of(mission):
    """100 nT over 700 samples: 16 ppm beside standard errors of 300."""
    assert not warned(mc.calibrate(mission(noise_nt=100.0).samples), "noise_in_scale")


def test_outliers_are_counted_where_no_loss_weighs_them(mission):
    """Every fiftieth reading 20,000 nT off one way: 14 of 700, all of them far beyond six deviations of 100 nT."""
    samples = mission(noise_nt=100.0).samples
    h_nt = samples.h_nt.copy()
    h_nt[::50] *= 1.0 + 20_000.0 / np.linalg.norm(h_nt[::50], axis=1, keepdims=True)
    spiked = mc.Samples(samples.t_utc, h_nt, b_ref_magnitude_nt=samples.b_ref_magnitude_nt)
    (told,) = warned(mc.calibrate(spiked, robust="none"), "outliers")
    assert told.startswith("outliers: 14 residuals")
    for robust in ("auto", "tukey"):
        weighed = mc.calibrate(spiked, robust=robust)
        assert not warned(weighed, "outliers")
        assert np.flatnonzero(weighed.residuals.weight == 0.0).tolist() == list(range(0, 700, 50))
