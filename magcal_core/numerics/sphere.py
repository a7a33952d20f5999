"""Directions on a sphere: latitude, longitude and equal-area maps of vectors."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats


def latitude_longitude_deg(v: Floats) -> tuple[Floats, Floats]:
    """Return latitude and longitude in (-180, 180], deg, of the directions of vectors of shape (n, 3) in any frame."""
    latitude = np.degrees(np.arctan2(v[:, 2], np.hypot(v[:, 0], v[:, 1])))
    return latitude, np.degrees(np.arctan2(v[:, 1], v[:, 0]))


def equal_area_disc(v: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return x, y in the unit disc and whether the upper hemisphere (+z) is meant, for vectors of shape (n, 3).

    Notes
    -----
    Lambert's azimuthal equal-area projection of each hemisphere about its pole, scaled so that the equator is the unit
    circle: rho = sqrt(1 - |u_z|), (x, y) = rho (u_x, u_y) / |(u_x, u_y)|. Equal areas of the sphere are equal areas of
    the disc. The lower hemisphere is seen through the sphere, so that x points the same way in both.
    """
    u = v / np.linalg.norm(v, axis=1, keepdims=True)
    across = np.hypot(u[:, 0], u[:, 1])
    rho = np.sqrt(np.clip(1.0 - np.abs(u[:, 2]), 0.0, 1.0))
    stretch = np.divide(rho, across, out=np.zeros_like(rho), where=across > 0)
    return stretch * u[:, 0], stretch * u[:, 1], u[:, 2] >= 0.0


@lru_cache(maxsize=4)
def even_directions(count: int) -> Floats:
    """Return unit vectors spread evenly over the sphere, shape (count, 3): a Fibonacci spiral."""
    turns = np.arange(count) + 0.5
    z = 1.0 - 2.0 * turns / count
    angle = turns * np.pi * (1.0 + np.sqrt(5.0))
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
