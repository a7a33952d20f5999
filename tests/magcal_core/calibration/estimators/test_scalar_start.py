"""The closed forms from moments against the least squares that they stand for, row by row."""

import numpy as np
import pytest

from magcal_core.calibration.estimators.scalar_start import closed_form_starts
from magcal_core.observations import Observations


@pytest.mark.parametrize("n", [60, 700])
@pytest.mark.parametrize("is_weighed", [False, True])
def test_starts_are_those_of_least_squares_over_the_rows(mission, n, is_weighed):
    """QR and SVD of all rows; moments square the condition, some 1e3 here: 1e-8 of the size of each unknown."""
    o = Observations.of(mission(n=n, noise_nt=50.0, seed=2).samples)
    random = np.random.default_rng(3)
    weights = np.where(random.random(n) < 0.2, 0.0, random.uniform(0.5, 2.0, n)) if is_weighed else np.ones(n)
    scale = 4e4
    h, b, root = o.h_nt / scale, o.b_nt / scale, np.sqrt(weights) / (2.0 * o.b_nt / scale)
    h1, h2, h3 = h.T
    square = np.column_stack([h1 * h1, h2 * h2, h3 * h3, 2 * h1 * h2, 2 * h1 * h3, 2 * h2 * h3])
    ten = np.column_stack([square, -2.0 * h, np.ones(n)])
    a11, a22, a33, a12, a13, a23, *rest = np.linalg.lstsq(ten * root[:, None], b**2 * root, rcond=None)[0]
    a = np.array([[a11, a12, a13], [a12, a22, a23], [a13, a23, a33]])
    bias, lower = np.linalg.solve(a, rest[:3]), np.linalg.inv(np.linalg.cholesky(np.linalg.inv(a)))
    five = np.column_stack([2.0 * h, b**2, -np.ones(n)])
    *centre, squared, _ = np.linalg.lstsq(five * root[:, None], np.sum(h**2, axis=1) * root, rcond=None)[0]

    first, *_, last = closed_form_starts(o.h_nt, o.b_nt, weights)
    np.testing.assert_allclose(first[:6], lower[np.tril_indices(3)], atol=1e-8)
    np.testing.assert_allclose(first[6:], lower @ bias * scale, atol=1e-8 * scale)
    np.testing.assert_allclose(last[:6], (np.eye(3) / np.sqrt(squared))[np.tril_indices(3)], atol=1e-8)
    np.testing.assert_allclose(last[6:], np.array(centre) / np.sqrt(squared) * scale, atol=1e-8 * scale)
