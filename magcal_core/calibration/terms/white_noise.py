"""White noise in the reading: whether it moves a parameter so far that the fit must take it into account."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, honest_covariance
from magcal_core.numerics.robust import robust_sigma
from magcal_core.observations import Observations

MOVED: Final = 0.5
"""Move of a parameter, in its standard errors, from which on the noise model is used."""
_NEVER: Final = 0.2
"""Largest move foretold, in standard errors that are too small, below which no parameter is moved by `MOVED`."""


def may_matter(observations: Observations, plain: Fit) -> bool:
    """Return whether noise may move a scale factor of the ``plain`` fit by a part of its standard error.

    Notes
    -----
    Noise of sigma makes the scale factors 2 sigma^2 / <B^2> too large (`docs/calibration.md`): that is a share of their
    formal errors which tells most sessions without a second fit.
    """
    noise_nt = robust_sigma(plain.residuals_nt[plain.weights > 0])
    foretold = 2.0 * noise_nt**2 / float(np.mean(observations.b_nt**2)) * np.abs(plain.parameters.scale)
    return bool(np.any(foretold >= _NEVER * np.sqrt(np.diag(plain.covariance)[3:6])))


def with_white_noise(
    estimator: Estimator, observations: Observations, settings: FitSettings, plain: Fit, shifts: Sequence[Floats]
) -> Fit | None:
    """Return the fit with white noise in the reading where that moves a parameter of the ``plain`` one; else None.

    ``shifts``: what errors of the reference do to the parameters, each of shape (p,) or more.
    """
    considered = np.sum([shift[:9] ** 2 for shift in shifts], axis=0) if shifts else np.zeros(9)
    known = np.diag(plain.covariance)[:9] + considered
    noise_nt = robust_sigma(plain.residuals_nt[plain.weights > 0])
    foretold = 2.0 * noise_nt**2 / float(np.mean(observations.b_nt**2)) * np.abs(plain.parameters.scale)
    if np.all(foretold < _NEVER * np.sqrt(known[3:6])):
        return None
    white = estimator.fit(observations, replace(settings, noise_model="white", near=None))
    honest = honest_covariance(plain.blocks, plain.covariance, len(observations), covered_s(observations.t_s))
    variances = np.diag(honest.covariance)[:9] + considered
    moves = np.abs(white.parameters.vector[:9] - plain.parameters.vector[:9])
    return white if np.any(moves > MOVED * np.sqrt(variances)) else None
