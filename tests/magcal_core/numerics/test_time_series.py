"""What people see of a series keeps its extremes, its gaps and its correlation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from magcal_core.numerics.time_series import autocorrelation, extreme_indices, gap_after, median_step_s

START = np.datetime64("2022-02-19T22:37:44", "ns")


def times(seconds: np.ndarray) -> np.ndarray:
    return START + np.rint(np.asarray(seconds) * 1e9).astype("timedelta64[ns]")


@given(arrays(np.float64, st.integers(1, 300), elements=st.floats(-1e6, 1e6)), st.integers(4, 50))
def test_thinning_keeps_ends_extremes_order_and_the_limit(values: np.ndarray, limit: int) -> None:
    index = extreme_indices(values, limit)
    assert len(index) <= limit
    assert np.all(np.diff(index) > 0)
    assert (index[0], index[-1]) == (0, len(values) - 1)
    assert (values[index].min(), values[index].max()) == (values.min(), values.max())


def test_thinning_passes_over_nan() -> None:
    values = np.sin(np.linspace(0, 60, 10_000))
    values[::3] = np.nan
    values[5000] = 40.0
    index = extreme_indices(values, 500)
    assert np.nanmax(values[index]) == 40.0
    assert np.nanmin(values[index]) == np.nanmin(values)


def test_a_gap_is_where_neighbours_are_ten_steps_apart() -> None:
    t_utc = times(np.array([0, 10, 20, 30, 500, 510, 520, 530]))
    assert median_step_s(t_utc) == 10.0
    assert gap_after(t_utc).tolist() == [3]


def test_autocorrelation_equals_the_direct_sum_over_pairs_with_missing_samples_and_a_gap() -> None:
    """Independent: the definition, pair by pair in O(n k). Tolerance 1e-12: both are sums of 300 terms of order one."""
    rng = np.random.default_rng(7)
    values = np.convolve(rng.normal(size=330), np.ones(31), "valid")
    stamp = np.delete(np.arange(300), [17, 18, 111])
    values = np.delete(values, [17, 18, 111])
    stamp[200:] += 100_000
    lag_s, r = autocorrelation(times(stamp * 10.0), values, 40)
    x = values - values.mean()
    direct = []
    for lag in range(41):
        i, j = np.nonzero(stamp[None, :] - stamp[:, None] == lag)
        direct.append(np.mean(x[i] * x[j]))
    np.testing.assert_allclose(lag_s, np.arange(41) * 10.0)
    np.testing.assert_allclose(r, np.array(direct) / direct[0], atol=1e-12)


def test_autocorrelation_of_an_ar1_series_decays_as_theory_says() -> None:
    """r(k) = phi^k; the standard error of an estimate from 1e5 samples with phi = 0.9 is below 0.02."""
    rng = np.random.default_rng(11)
    values = np.empty(100_000)
    values[0] = 0.0
    for i, shock in enumerate(rng.normal(size=99_999)):
        values[i + 1] = 0.9 * values[i] + shock
    _, r = autocorrelation(times(np.arange(100_000)), values, 20)
    np.testing.assert_allclose(r, 0.9 ** np.arange(21), atol=0.06)


@pytest.mark.parametrize("values", [np.zeros(0), np.array([1.0]), np.full(9, 3.0), np.full(9, np.nan)])
def test_a_series_without_variation_has_no_autocorrelation(values: np.ndarray) -> None:
    lag_s, r = autocorrelation(times(np.arange(len(values))), values, 5)
    assert lag_s.size == r.size == 0
