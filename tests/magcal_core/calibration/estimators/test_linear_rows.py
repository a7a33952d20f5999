"""Rows linearised about a fit, against differences of the residuals themselves."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.linear_rows import rows_of
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.observations import Observations
from magcal_core.sensor.model import lower_triangular_gauge, parameters_of_matrix


@pytest.fixture(scope="module")
def flown(mission):
    """A mission with a temperature that moves the bias, and a fall of the reference by the clock."""
    made = Observations.of(mission(n=300, noise_nt=50.0).samples)
    rng = np.random.default_rng(2)
    temperature = np.cumsum(rng.normal(size=300))
    rate = rng.normal(size=(300, 3)) * 20.0
    along = np.einsum("ni,ni->n", rate, made.b_base_nt) / made.b_nt
    return replace(
        made,
        h_nt=made.h_nt + temperature[:, None] * [3.0, -5.0, 8.0],
        regressors={"temperature": temperature},
        rate_nt_s=along[:, None],
        rate_base_nt_s=rate[:, None, :],
    )


def still(observations):
    return replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)


@pytest.mark.parametrize(("method", "noise"), [("scalar", "none"), ("scalar", "white"), ("vector", "none")])
def test_derivatives_are_those_of_the_residual(flown, method, noise):
    """Central differences of y, unknown by unknown: to 1e-3 of each row's own size (1e-2 where noise turns the row)."""
    fit = ESTIMATORS[method].fit(still(flown), FitSettings(noise_model=noise))
    here = rows_of(flown, fit)
    assert here.unknowns.size == 13
    sigmas = [channel.sigma_nt for channel in here.channels]
    for unknown in range(12):
        column = np.concatenate([np.abs(c.jacobian[:, c.places == unknown]).ravel() for c in here.channels])
        if not column.size:
            continue
        step = np.zeros(13)
        step[unknown] = 1e-3 / max(column.max(), 1e-12)
        ends = [rows_of(flown, fit, sigmas_nt=sigmas, at=here.moved(sign * step)) for sign in (1.0, -1.0)]
        for i, channel in enumerate(here.channels):
            found = (ends[1].channels[i].y - ends[0].channels[i].y) / (2.0 * step[unknown])
            want = channel.jacobian[:, channel.places == unknown].sum(axis=1)
            tolerance = 1e-2 if noise == "white" else 1e-3
            np.testing.assert_allclose(found, want, atol=tolerance * max(np.abs(want).max(), column.max()))


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_a_later_clock_shows_as_its_column_says(flown, method):
    """The reference taken half a second later: y changes by minus the column of the clock."""
    fit = ESTIMATORS[method].fit(still(flown), FitSettings())
    here = rows_of(flown, fit)
    for channel in here.channels:
        column = channel.jacobian[:, channel.places == 12][:, 0]
        if method == "scalar":
            later = replace(fit, residuals_nt=fit.residuals_nt + 0.5 * flown.rate_nt_s[:, 0])
            moved = rows_of(flown, later, sigmas_nt=[channel.sigma_nt]).channels[0].y
            np.testing.assert_allclose(moved - channel.y, -0.5 * column, atol=1e-6)
        else:
            later = replace(fit, residuals_nt=fit.residuals_nt + 0.5 * flown.rate_base_nt_s[:, 0])
            moved = rows_of(flown, later, sigmas_nt=[c.sigma_nt for c in here.channels])
            mine = moved.channels[channel.axes[0]]
            np.testing.assert_allclose(mine.y - channel.y, -0.5 * column, atol=1e-6)


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_one_step_of_the_rows_is_the_fit(flown, method):
    """J'y vanishes at the estimate, and the covariance of the rows is the formal one, to 1e-4 of an error."""
    fit = ESTIMATORS[method].fit(still(flown), FitSettings())
    rows = rows_of(still(flown), fit)
    moments = rows.moments(np.zeros((300, 0)), np.array([0, 100, 200]))
    q = rows.unknowns.size
    inverse = np.linalg.inv(moments.total[:q, :q])
    step = inverse @ moments.total[:q, q]
    assert np.all(np.abs(step) < 1e-3 * np.sqrt(np.diag(inverse)))
    own = rows.unknowns.to_parameters(rows.matrix)
    errors = np.sqrt(np.diag(own @ inverse @ own.T))
    np.testing.assert_allclose(errors, np.sqrt(np.diag(fit.covariance)), rtol=0.02)


def test_full_matrix_reaches_the_parameters_through_its_gauge(flown):
    """Derivative of (b, k, e) of T_low by all nine elements of a T that is far from triangular: differences, 1e-6."""
    fit = ESTIMATORS["vector"].fit(still(flown), FitSettings())
    rows = rows_of(still(flown), fit, is_full=True)
    rng = np.random.default_rng(4)
    matrix = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    own = rows.unknowns.to_parameters(matrix)
    for at, (i, j) in enumerate(rows.unknowns.entries):
        found = []
        for sign in (1.0, -1.0):
            moved = matrix.copy()
            moved[i, j] += sign * 1e-6
            scale, angles = parameters_of_matrix(lower_triangular_gauge(moved)[0])
            found.append(np.concatenate([scale, np.rad2deg(angles)]))
        np.testing.assert_allclose((found[0] - found[1]) / 2e-6, own[3:9, at], atol=1e-5)
