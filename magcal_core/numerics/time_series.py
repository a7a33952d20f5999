"""Series in time as people look at them: thinned without losing an extreme, and compared with themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times


def extreme_indices(values: Floats, limit: int) -> NDArray[np.intp]:
    """Return at most ``limit`` indices, ascending, that keep the least and the greatest value of every stretch.

    Parameters
    ----------
    values : shape (n,)
        NaN is passed over, except where a whole stretch is NaN.
    limit : int
        At least 4.
    """
    n = len(values)
    if n <= limit:
        return np.arange(n)
    stretches = (limit - 2) // 2
    length = -(-n // stretches)
    padded = np.full((-(-n // length)) * length, np.nan)
    padded[:n] = values
    rows = padded.reshape(-1, length)
    start = np.arange(len(rows)) * length
    least = start + np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1)
    greatest = start + np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1)
    chosen: NDArray[np.intp] = np.unique(np.concatenate([[0], least, greatest, [n - 1]])).astype(np.intp)
    return chosen


def seconds_from_start(t_utc: Times) -> Floats:
    """Return the seconds since the first of ``t_utc``, shape (n,)."""
    elapsed: Floats = (t_utc - t_utc[0]) / np.timedelta64(1, "s") if len(t_utc) else np.zeros(0)
    return elapsed


def median_step_s(t_utc: Times) -> float:
    """Return the median time between neighbours, s; 1 where there are no two times."""
    steps = np.diff(seconds_from_start(t_utc))
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 1.0


def gap_after(t_utc: Times, factor: float = 10.0) -> NDArray[np.intp]:
    """Return the indices of the samples that are followed by a gap longer than ``factor`` median steps."""
    steps = np.diff(seconds_from_start(t_utc))
    gaps: NDArray[np.intp] = np.flatnonzero(steps > factor * median_step_s(t_utc))
    return gaps


def autocorrelation(t_utc: Times, values: Floats, max_lag: int) -> tuple[Floats, Floats]:
    """Return lags, s, and the autocorrelation of ``values`` at them, each of shape (m,), from lag 0 on.

    Samples are put on a grid of the median step; pairs across a gap longer than the largest lag do not count, and
    a lag without pairs is NaN.

    Notes
    -----
    r(k) = (sum_i x_i x_{i+k} / pairs(k)) / (sum_i x_i^2 / n) with x the values less their mean; the sums are taken by
    FFT over the values and over their mask.
    """
    is_known = np.isfinite(values)
    t_known, x = t_utc[is_known], values[is_known]
    if x.size < 2 or np.ptp(x) == 0.0:
        return np.zeros(0), np.zeros(0)
    step_s = median_step_s(t_known)
    strides = np.rint(np.diff(seconds_from_start(t_known)) / step_s).astype(np.int64)
    max_lag = int(min(max_lag, x.size - 1))
    place = np.concatenate([[0], np.cumsum(np.clip(strides, 1, max_lag + 1))])
    size = int(place[-1]) + 1
    series, mask = np.zeros(size), np.zeros(size)
    series[place] = x - x.mean()
    mask[place] = 1.0
    length = 1 << (size + max_lag).bit_length()
    products = np.fft.irfft(np.abs(np.fft.rfft(series, length)) ** 2, length)[: max_lag + 1]
    pairs = np.rint(np.fft.irfft(np.abs(np.fft.rfft(mask, length)) ** 2, length)[: max_lag + 1])
    mean_product = np.divide(products, pairs, out=np.full(max_lag + 1, np.nan), where=pairs > 0)
    lags_s: Floats = step_s * np.arange(max_lag + 1, dtype=np.float64)
    coefficients: Floats = mean_product / mean_product[0]
    return lags_s, coefficients
