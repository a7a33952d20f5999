"""Andrews' quadratic-spectral estimator of a long-run covariance, written from the paper: no code of magcal's.

Donald W. K. Andrews, Heteroskedasticity and autocorrelation consistent covariance matrix estimation, Econometrica 59
(1991) 817: kernel (2.7), bandwidth 1.3221 (alpha(2) n)^(1/5), (6.2), with alpha(2) of first-order autoregressions of
the scores, (6.4), all weights alike once each score has unit size.
"""

import numpy as np


def long_run_covariance(scores):
    """Return the covariance of the sum of ``scores``, shape (n, q), that have mean zero."""
    n = len(scores)
    size = np.sqrt(np.mean(scores**2, axis=0))
    bandwidth = max(1.3221 * (_alpha(scores / size) * n) ** 0.2, 1e-6)
    middle = scores.T @ scores
    for lag in range(1, n):
        x = 6.0 * np.pi * lag / bandwidth / 5.0
        weight = 3.0 / x**2 * (np.sin(x) / x - np.cos(x))
        if x > 60.0 * np.pi:
            break
        across = scores[lag:].T @ scores[:-lag]
        middle += weight * (across + across.T)
    return middle


def _alpha(scores):
    """Return alpha(2): how fast the spectra of the scores, taken for first-order autoregressions, bend at zero."""
    before, after = scores[:-1], scores[1:]
    rho = np.clip(np.sum(before * after, axis=0) / np.sum(before**2, axis=0), -0.97, 0.97)
    left = np.mean((after - rho * before) ** 2, axis=0)
    return np.sum(4.0 * rho**2 * left**2 / (1.0 - rho) ** 8) / np.sum(left**2 / (1.0 - rho) ** 4)
