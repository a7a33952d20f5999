"""Directions: angles and equal areas."""

import numpy as np

from magcal_core.numerics.sphere import equal_area_disc, latitude_longitude_deg


def test_latitude_and_longitude_of_known_directions() -> None:
    v = np.array([[2.0, 0, 0], [0, 3, 0], [0, 0, -5], [-1, 0, 0], [1, -1, np.sqrt(2)]])
    latitude, longitude = latitude_longitude_deg(v)
    np.testing.assert_allclose(latitude, [0, 0, -90, 0, 45], atol=1e-12)
    np.testing.assert_allclose(longitude[[0, 1, 3, 4]], [0, 90, 180, -45], atol=1e-12)


def test_directions_spread_evenly_over_the_sphere_are_even_in_area_on_the_discs() -> None:
    """Independent: a uniform sphere has a quarter of a hemisphere's points in half the disc's radius; 400,000 points
    give it to 0.25 +- 0.001 (one sigma), tolerance four of them."""
    v = np.random.default_rng(3).normal(size=(400_000, 3))
    x, y, is_upper = equal_area_disc(v)
    radius = np.hypot(x, y)
    assert radius.max() <= 1.0 + 1e-12
    for side in (is_upper, ~is_upper):
        assert abs(np.mean(radius[side] < 0.5) - 0.25) < 0.004


def test_the_poles_and_axes_fall_where_the_labels_stand() -> None:
    x, y, is_upper = equal_area_disc(np.array([[0.0, 0, 1], [0, 0, -1], [7, 0, 0], [0, -7, 0]]))
    np.testing.assert_allclose(np.stack([x, y], axis=1), [[0, 0], [0, 0], [1, 0], [0, -1]], atol=1e-15)
    assert is_upper[:2].tolist() == [True, False]
