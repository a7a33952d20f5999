"""Which normal matrices determine what they are of, by matrices whose least pivot is chosen."""

import numpy as np
import pytest

from magcal_core.numerics.linear_algebra import (
    floored_inverse,
    is_positive_definite,
    scaled_condition,
    scaled_inverse,
    scaled_solution,
    unit_diagonal,
)


def of_pivot(smallest: float) -> np.ndarray:
    """A matrix of unit columns of which the last keeps ``smallest`` of its square beside the others."""
    together = np.sqrt(1.0 - smallest)
    normal = np.eye(4)
    normal[2, 3] = normal[3, 2] = together
    return normal


@pytest.mark.parametrize(("pivot", "is_one"), [(1.0, True), (1e-6, True), (1e-9, True), (1e-13, False), (0.0, False)])
@pytest.mark.parametrize("unit", [1.0, 1e-15, 1e30])
def test_the_least_pivot_tells_whatever_the_units(pivot, is_one, unit):
    size = np.array([1.0, unit, unit, 1e3])
    assert is_positive_definite(of_pivot(pivot) * np.outer(size, size)) == is_one


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 0.0, -1.0])
def test_a_column_that_is_no_number_or_none_at_all_determines_nothing(wrong):
    normal = np.eye(3)
    normal[1, 1] = wrong
    assert not is_positive_definite(normal)


UNITS = np.array([1e-12, 1.0, 1e9, 1e3])


@pytest.fixture
def normal() -> np.ndarray:
    """A well conditioned matrix in units that span 21 decades."""
    inner = np.array([[1.0, 0.3, 0.1, 0.0], [0.3, 1.0, 0.2, 0.1], [0.1, 0.2, 1.0, 0.4], [0.0, 0.1, 0.4, 1.0]])
    return inner * np.outer(UNITS, UNITS)


def test_inverse_and_solution_lose_no_digits_to_units(normal):
    """The scaled matrix has a condition of 3: sixteen digits less one are left, whatever the units."""
    known = np.array([1.0, -2.0, 3.0, 0.5]) / UNITS
    inverse, right = scaled_inverse(normal), normal @ known
    np.testing.assert_allclose((inverse @ normal) * np.outer(UNITS, 1.0 / UNITS), np.eye(4), atol=1e-14)
    np.testing.assert_allclose(scaled_solution(normal, right), known, rtol=1e-13)
    both = scaled_solution(normal, np.column_stack([right, 2.0 * right]))
    np.testing.assert_allclose(both[:, 1], 2.0 * both[:, 0], rtol=1e-14)
    np.testing.assert_allclose(both[:, 0], scaled_solution(normal, right), rtol=1e-14)
    np.testing.assert_allclose(floored_inverse(normal, 1e-12), inverse, rtol=1e-12)


def test_the_condition_is_that_of_unit_columns(normal):
    scaled, size = unit_diagonal(normal)
    np.testing.assert_allclose(np.diag(scaled), 1.0)
    np.testing.assert_allclose(size, UNITS)
    assert scaled_condition(normal) == pytest.approx(np.linalg.cond(scaled))
    assert scaled_condition(normal) < 4.0


def test_a_floor_bounds_what_an_inverse_says_of_what_is_not_determined():
    """Two columns that are one: the eigenvalue 0 counts as the floor."""
    found = floored_inverse(np.array([[4.0, 4.0], [4.0, 4.0]]), 0.1)
    # Eigenvalues 2 and 0 of [[1, 1], [1, 1]]: 1/2 along (1, 1), 1/0.1 along (1, -1), and 4 for the diagonal.
    np.testing.assert_allclose(found, np.array([[0.25 + 5.0, 0.25 - 5.0], [0.25 - 5.0, 0.25 + 5.0]]) / 4.0)
