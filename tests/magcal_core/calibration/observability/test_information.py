"""What the samples determine, from moments, against the design matrices that those moments stand for."""

import numpy as np
from scipy.linalg import eigh

from magcal_core.calibration.observability.information import scalar_information

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def test_indices_are_those_of_the_designs_themselves():
    """Singular values of the unit design; signal over the noise that each component of the reading puts into it.

    The second is the root of a difference from one: 1e-8 of rounding.
    """
    random = np.random.default_rng(5)
    x = random.normal(size=(400, 3)) * np.array([30_000.0, 20_000.0, 9_000.0]) + np.array([4000.0, 0.0, -3000.0])
    matrix = np.array([[1.03, 0.0, 0.0], [0.1, 0.97, 0.0], [-0.05, 0.02, 1.1]])
    noise_nt, mean = 900.0, np.linalg.norm(x, axis=1).mean()
    u, factor = x / mean, {True: 1.0, False: np.sqrt(2.0)}

    def polynomials(v):
        return np.column_stack([v[:, i] * v[:, j] * factor[i == j] for i, j in PAIRS] + [v])

    unit = polynomials(u) / np.linalg.norm(u, axis=1)[:, None]
    noise, step = np.zeros((9, 9)), 1e-3
    for column in np.linalg.inv(matrix).T:
        # A parabola's central difference is its slope.
        slopes = (polynomials(u + step * column) - polynomials(u - step * column)) / (2.0 * step)
        noise += slopes.T @ slopes / len(u)
    signal = polynomials(u).T @ polynomials(u) / len(u)
    ratio = eigh(signal, noise * (noise_nt / mean) ** 2, eigvals_only=True)[0]
    information = scalar_information(x, matrix, noise_nt)
    smallest = np.linalg.svd(unit, compute_uv=False)[-1] / np.sqrt(len(u))
    np.testing.assert_allclose(information.index, smallest / (noise_nt / mean), rtol=1e-10)
    np.testing.assert_allclose(information.noise_safe_index, np.sqrt(max(ratio - 1.0, 0.0)), rtol=1e-8)
