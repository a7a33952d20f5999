"""Band matrices against LAPACK."""

import numpy as np
import pytest
from scipy.linalg import cho_solve_banded, cholesky_banded

from magcal_core.arrays import Floats
from magcal_core.numerics.bands import band_factor, band_solution


def band_of(size: int, width: int) -> Floats:
    """Return a positive definite band matrix: its diagonal outweighs each row."""
    rng = np.random.default_rng(size + width)
    band = rng.uniform(-1.0, 1.0, (width, size))
    band[0] = 2.0 * width
    for diagonal in range(1, width):
        band[diagonal, max(size - diagonal, 0) :] = np.nan  # beyond the matrix: not read
    return band


@pytest.mark.parametrize(("size", "width"), [(1, 1), (2, 4), (7, 4), (96, 4), (40, 7)])
def test_factor_and_solution_are_lapacks(size: int, width: int) -> None:
    """Some ten roundings an element; the diagonal outweighs the rest, so that none is multiplied."""
    band, right = band_of(size, width), np.random.default_rng(3).normal(size=(size, 5))
    lapacks = cholesky_banded(np.nan_to_num(band), lower=True)
    factor, inside = band_factor(band), ~np.isnan(band)
    np.testing.assert_allclose(factor[inside], lapacks[inside], rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(
        band_solution(factor, right), cho_solve_banded((lapacks, True), right), rtol=1e-12, atol=1e-15
    )


def test_neither_changes_what_it_is_given() -> None:
    band, right = band_of(9, 4), np.ones((9, 2))
    before = band.copy()
    band_solution(band_factor(band), right)
    np.testing.assert_array_equal(band, before)
    np.testing.assert_array_equal(right, np.ones((9, 2)))


@pytest.mark.parametrize("spoilt", [-1.0, 0.0, np.nan])
def test_what_is_not_positive_definite_is_refused(spoilt: float) -> None:
    band = band_of(9, 4)
    band[0, 5] = spoilt
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        band_factor(band)
