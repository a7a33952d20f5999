"""What a loss leaves of the information, where the worst of three residuals decides."""

import numpy as np
import pytest

from magcal_core.numerics.robust import TUNING, shared_weight_slope


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_axis_that_loses_most_counts(axis):
    """Huber, 20 of 100 worst on one axis at twice the bend: weight 1/2, slope 0; the rest whole: 90 / (90 - 10)."""
    scaled = np.full((100, 3), 0.1)
    scaled[:, (axis + 1) % 3] = 0.2
    scaled[:20, axis] = 2.0 * TUNING[1]
    weight = np.where(np.arange(100) < 20, 0.5, 1.0)
    assert shared_weight_slope(scaled, np.ones(100), weight, "huber") == pytest.approx(90.0 / 80.0, rel=1e-12)
