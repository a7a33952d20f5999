"""The compiled passes over readings, residuals and directions against the same in plain numpy."""

import numpy as np
import pytest

from magcal_core.calibration.diagnosis.sample_flags import JUMP, JUMP_NOISE, jumps
from magcal_core.calibration.observability.information import sphere_coverage, sphere_motion
from magcal_core.calibration.residuals import statistics
from magcal_core.numerics.medians import peaks_above, running_median
from magcal_core.numerics.robust import robust_sigma
from magcal_core.numerics.vectors import lengths
from magcal_core.sensor.correction import correct, corrected_lengths, readings_without
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows


@pytest.mark.parametrize("order", ["C", "F"])
def test_readings_are_corrected_as_by_a_matrix_product(order):
    """Rounding of 5e4 nT: 1e-10 nT. Missing readings stay missing; read-only and Fortran-ordered arrays are taken."""
    random = np.random.default_rng(1)
    h_nt = np.array(30000.0 * random.normal(size=(1000, 3)), order=order)
    h_nt[5, 1] = np.nan
    h_nt.flags.writeable = False
    lower, bias_nt = np.tril(np.eye(3) + 0.1 * random.normal(size=(3, 3))), np.array([3000.0, -1200.0, 50.0])
    with np.errstate(invalid="ignore"):
        want = (h_nt - bias_nt) @ lower.T
    got = correct(h_nt, bias_nt, lower)
    is_known = np.isfinite(h_nt).all(axis=1)
    np.testing.assert_allclose(got[is_known], want[is_known], atol=1e-10)
    assert np.isnan(got[5, 1:]).all()
    np.testing.assert_allclose(lengths(h_nt), np.linalg.norm(h_nt, axis=1), rtol=1e-15)


@pytest.mark.parametrize("width", [1, 7, 9])
@pytest.mark.parametrize("n", [0, 5, 9, 400])
def test_running_medians_are_those_of_numpy(n, width):
    """Exact: a median of an odd number of values is one of them."""
    values = np.round(np.random.default_rng(n).normal(size=n), 1)
    got = running_median(values, width)
    if n < width:
        assert got.size == 0
    else:
        np.testing.assert_array_equal(got, np.median(np.lib.stride_tricks.sliding_window_view(values, width), axis=1))


def test_a_running_median_ends_where_values_are_no_numbers():
    """What the windows without one have for a median is not touched by those that come later."""
    values = np.random.default_rng(1).normal(size=60)
    values[40:45] = np.nan
    got = running_median(values, 7)
    windows = np.lib.stride_tricks.sliding_window_view(values[:40], 7)
    np.testing.assert_array_equal(got[: len(windows)], np.median(windows, axis=1))


def test_peaks_are_those_of_a_running_maximum():
    """Ties on either side included."""
    values = np.round(np.abs(np.random.default_rng(4).normal(size=500)), 1)
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(values, 9), 19).max(axis=1)
    np.testing.assert_array_equal(peaks_above(values, 1.2, 9), (values > 1.2) & (values == highest))


def test_jumps_are_those_of_sliding_windows():
    """The definition written out in numpy on a series with steps, waves and noise."""
    random = np.random.default_rng(8)
    row = 40.0 * random.normal(size=800) + 300.0 * np.sin(np.arange(800) / 30.0)
    row[250:] += 900.0
    row[600:] -= 700.0
    windows = np.median(np.lib.stride_tricks.sliding_window_view(row, 9), axis=1)
    step = np.zeros(800)
    step[9:792] = np.abs(windows[9:] - windows[:-9])
    limit = max(JUMP * np.median(step), JUMP_NOISE * 1.4826 * np.median(np.abs(np.diff(row))) / np.sqrt(2.0))
    highest = np.lib.stride_tricks.sliding_window_view(np.pad(step, 9), 19).max(axis=1)
    is_peak = (step > limit) & (step == highest)
    np.testing.assert_array_equal(jumps(row), is_peak & ~np.concatenate([[False], is_peak[:-1]]))


@pytest.mark.parametrize("kind", ["sphere", "plane", "few"])
def test_coverage_is_that_of_every_direction(kind):
    """All pairs in numpy: cells of a degree move the rim by a share of a cap, 0.02 of the sphere."""
    random = np.random.default_rng(3)
    u = random.normal(size=(12 if kind == "few" else 3000, 3)) * ([1.0, 1.0, 0.0] if kind == "plane" else 1.0)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    turns = np.arange(600) + 0.5
    z, angle = 1.0 - turns / 300.0, turns * np.pi * (1.0 + np.sqrt(5.0))
    grid = np.column_stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z])
    want = np.mean((grid @ u.T).max(axis=1) >= np.cos(np.deg2rad(15.0)))
    assert sphere_coverage(u) == pytest.approx(want, abs=0.02)


def test_directions_that_are_none_cover_nothing():
    """A reading of zero length has no direction."""
    assert sphere_coverage(np.full((3, 3), np.nan)) == 0.0


@pytest.mark.parametrize("shape", [(1,), (2,), (701,), (40, 3)])
def test_robust_scales_are_numpys_medians(shape):
    """Exact; one missing value and there is no median."""
    residuals = np.random.default_rng(5).normal(size=shape)
    assert robust_sigma(residuals) == 1.4826 * float(np.median(np.abs(residuals)))
    residuals.flat[0] = np.nan
    assert np.isnan(robust_sigma(residuals))


@pytest.mark.parametrize("components", [1, 3])
def test_statistics_are_numpys_over_samples_that_have_weight(components):
    """Sums in another order: 1e-12 of the spread."""
    random = np.random.default_rng(8)
    r, b = random.normal(3.0, 50.0, (2500, components)), random.uniform(2e4, 6e4, 2500)
    weights = (random.random(2500) > 0.1).astype(float)
    used = weights > 0
    mean, variance, largest, share = statistics(r, b, weights)
    assert mean == pytest.approx(r[used].mean(), abs=5e-11)
    assert variance == pytest.approx(r[used].var(), rel=1e-12)
    assert largest == np.abs(r[used]).max()
    assert share == (np.abs(r[used]) / b[used, None]).max()


def test_motion_over_the_sphere_is_that_of_the_unit_vectors_themselves():
    """Moments in one pass about the first direction, against numpy's of every vector: rounding only."""
    random = np.random.default_rng(9)
    h, bias = random.normal(size=(3000, 3)) * [3e4, 2e4, 1e4], np.array([500.0, -300.0, 200.0])
    lower = np.array([[1.1, 0.0, 0.0], [0.05, 0.9, 0.0], [-0.1, 0.02, 1.0]])
    weights = (random.random(3000) > 0.2).astype(float)
    found = sphere_motion(h, weights, bias, lower)
    x = (h[weights > 0] - bias) @ lower.T
    u = x / np.linalg.norm(x, axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.cov(u.T, bias=True))
    np.testing.assert_allclose(found.centre, u.mean(axis=0), rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.spreads, np.sqrt(values), rtol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(found.axes * axes, axis=0)), 1.0, rtol=1e-12)
    assert found.coverage == sphere_coverage(u)


def test_corrected_lengths_are_those_of_the_corrected_readings():
    """The vectors are not kept; the same products, in 1e-15 of the length."""
    h_nt = 3e4 * np.random.default_rng(10).normal(size=(500, 3))
    lower, bias_nt = np.array([[1.1, 0.0, 0.0], [0.05, 0.9, 0.0], [-0.1, 0.02, 1.0]]), np.array([500.0, -300.0, 200.0])
    want = np.linalg.norm((h_nt - bias_nt) @ lower.T, axis=1)
    np.testing.assert_allclose(corrected_lengths(h_nt, bias_nt, lower), want, rtol=2e-15)


def test_what_a_regressor_adds_is_taken_off_again_and_the_bias_is_that_at_its_zero():
    """Readings made here by hand, without noise, with a column whose mean is far from zero."""
    rng = np.random.default_rng(5)
    field_nt = 40_000.0 * rng.normal(size=(300, 3))
    column = rng.uniform(20.0, 60.0, 300)
    bias_nt, slopes_nt = np.array([900.0, -400.0, 250.0]), np.array([7.0, -3.0, 11.0])
    readings_nt = field_nt + bias_nt + column[:, None] * slopes_nt
    z = Standardised.of(("panel",), [column], 300)
    found = parameters_from_rows(np.eye(3), bias_nt + z.mean[0] * slopes_nt, slopes_nt[None, :] * z.spread[0], z)
    np.testing.assert_allclose(found.bias_nt, bias_nt, rtol=1e-12)
    np.testing.assert_allclose(found.regressors["panel"], slopes_nt, rtol=1e-12)
    left_nt = readings_without({"panel": column}, readings_nt, found)
    np.testing.assert_allclose(left_nt, field_nt + bias_nt, atol=1e-9)
