"""Spikes, jumps and saturation are found where they were planted, and nowhere else."""

import numpy as np
import pytest

from magcal_core.calibration.diagnosis.sample_flags import jumps, saturated, spikes
from magcal_core.pipeline import calibrate
from magcal_core.samples import SampleFlag


@pytest.fixture
def noise():
    return 50.0 * np.random.default_rng(3).normal(size=1000)


def test_spikes_are_found(noise):
    at = [5, 100, 101, 640, 999]
    noise[at] += [900, -1200, 800, 2500, -900]
    assert np.flatnonzero(spikes(noise)).tolist() == at


def test_slow_waves_are_no_spikes(noise):
    assert not spikes(noise + 400 * np.sin(np.arange(1000) / 60)).any()


def test_a_jump_is_found_at_its_first_sample(noise):
    noise[400:] += 600.0
    found = np.flatnonzero(jumps(noise - np.median(noise)))
    assert len(found) == 1
    assert abs(found[0] - 400) <= 2


def test_noise_has_neither_spike_nor_jump():
    """6 sigma: expected false alarms in 20 x 1000 samples below 1e-4."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        residuals = rng.normal(size=(1000, 3))
        assert not spikes(residuals).any()
        assert not jumps(residuals).any()


def test_clipped_readings_are_found():
    h = np.random.default_rng(2).normal(size=(500, 3)) * 30000
    clipped = np.clip(h, -45000, 45000)
    clipped[200:204, 1] = 45000.0
    clipped[50:54, 0] = -45000.0
    clipped[300:304, 2] = 45000.0
    found = saturated(clipped)
    assert found[[50, 200, 300]].all()
    assert not found[(np.abs(clipped) < 45000).all(axis=1)].any()
    assert not saturated(h).any()


def test_flags_stand_in_the_residual_table_and_change_nothing(mission):
    from dataclasses import replace

    samples = mission(noise_nt=50.0).samples
    h = samples.h_nt.copy()
    h[123] += 8000.0
    plain = calibrate(replace(samples, h_nt=h), robust="none")
    flagged = np.flatnonzero(plain.residuals.flags & SampleFlag.SPIKE)
    assert flagged.tolist() == [123]
    assert plain.residuals.weight[123] == 1.0


def test_the_loss_of_the_default_puts_the_spike_aside_and_its_flag_stands_too(mission):
    from dataclasses import replace

    samples = mission(noise_nt=50.0).samples
    h = samples.h_nt.copy()
    h[123] += 8000.0
    got = calibrate(replace(samples, h_nt=h))
    assert np.flatnonzero(got.residuals.flags & SampleFlag.SPIKE).tolist() == [123]
    assert got.residuals.weight[123] == 0.0
