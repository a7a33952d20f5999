"""Which normal matrices determine what they are of, by matrices whose least pivot is chosen."""

import numpy as np
import pytest

from magcal_core.numerics.linear_algebra import is_positive_definite


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
