"""The sensor model h = T B + b: parameters to matrices and back, apply and un-apply, and the parameter conventions.

Notes
-----
T = diag(k) P with the unit sensing axes as the rows of P: (1, 0, 0), (sin e1, cos e1, 0),
(sin e2, cos e2 sin e3, cos e2 cos e3) [DEKART]_, [LAGRANGE]_. T is lower triangular: axis 1 defines x, axes 1 and 2 the
xy plane of the magnetometer's base frame. The other conventions say the same of |B| with other numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from magcal_core.arrays import Floats
from magcal_core.errors import Fault, OptionError


@dataclass(frozen=True, slots=True, eq=False)
class SensorModel:
    """A three-axis magnetometer: zero offset, nT, scale factors and non-orthogonality angles, deg.

    Raises
    ------
    OptionError
        A value is not finite, a scale factor is zero or an angle is not within +-90 deg.
    """

    bias_nt: Floats
    scale: Floats
    nonorthogonality_deg: Floats

    def __post_init__(self) -> None:
        faults = []
        for name in ("bias_nt", "scale", "nonorthogonality_deg"):
            value = np.array(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, value)
            if value.shape != (3,) or not np.isfinite(value).all():
                faults.append(Fault(name, "want three finite numbers"))
        if not faults and not np.all(self.scale):
            faults.append(Fault("scale", "a scale factor is zero: that axis does not measure"))
        if not faults and np.any(np.abs(self.nonorthogonality_deg) >= 90.0):
            faults.append(Fault("nonorthogonality_deg", "an angle is not within +-90 deg"))
        if faults:
            raise OptionError("these are not the parameters of a magnetometer", faults)

    @classmethod
    def from_matrix(cls, bias_nt: ArrayLike, matrix: ArrayLike) -> SensorModel:
        """Return the sensor with zero offset ``bias_nt``, shape (3,), nT, and lower-triangular ``matrix`` T.

        Raises
        ------
        OptionError
            T is singular or not lower triangular; `lower_triangular_gauge` splits a rotation off.
        """
        t = np.array(matrix, dtype=np.float64)
        if t.shape != (3, 3) or np.abs(np.triu(t, 1)).max() > 1e-12 * np.abs(t).max():
            raise OptionError("matrix: want a 3 x 3 lower-triangular matrix; split a rotation off first")
        scale, angles_rad = parameters_of_matrix(t)
        return cls(np.array(bias_nt, dtype=np.float64), scale, np.rad2deg(angles_rad))

    @property
    def matrix(self) -> Floats:
        """T, shape (3, 3): true field in the base frame to reading."""
        return matrix_of_parameters(self.scale, np.deg2rad(self.nonorthogonality_deg))

    @property
    def correction_matrix(self) -> Floats:
        """Inverse of T, shape (3, 3): reading to true field in the base frame."""
        return inverse_lower(self.matrix)

    def apply(self, b_nt: ArrayLike) -> Floats:
        """Return the readings, shape (..., 3), nT, of true fields ``b_nt`` in the base frame, shape (..., 3), nT."""
        return np.asarray(b_nt, dtype=np.float64) @ self.matrix.T + self.bias_nt

    def correct(self, h_nt: ArrayLike) -> Floats:
        """Return the fields in the base frame, shape (..., 3), nT, from readings ``h_nt``, shape (..., 3), nT."""
        return (np.asarray(h_nt, dtype=np.float64) - self.bias_nt) @ self.correction_matrix.T


def matrix_of_parameters(scale: Floats, angles_rad: Floats) -> Floats:
    """Return T = diag(k) P, shape (3, 3), from scale factors k and angles e1, e2, e3, rad [DEKART]_."""
    s, c = np.sin(angles_rad), np.cos(angles_rad)
    p = np.array([[1.0, 0.0, 0.0], [s[0], c[0], 0.0], [s[1], c[1] * s[2], c[1] * c[2]]])
    return np.asarray(scale[:, None] * p)


def parameters_of_matrix(matrix: Floats) -> tuple[Floats, Floats]:
    """Return the scale factors, signed, and the angles, rad, within +-90 deg, of a lower-triangular T.

    Raises
    ------
    OptionError
        A diagonal element is zero: an axis lies in the span of the axes before it.
    """
    diagonal = np.diag(matrix)
    lengths = np.sqrt(np.sum(matrix**2, axis=1))
    if not np.isfinite(matrix).all() or np.any(np.abs(diagonal) <= 1e-15 * np.maximum(lengths, 1e-300)):
        raise OptionError("matrix: the sensing axes do not span space")
    scale = np.sign(diagonal) * lengths
    u = matrix[2] / scale[2]
    angles_rad = np.array(
        [np.arctan(matrix[1, 0] / matrix[1, 1]), np.arctan2(u[0], np.hypot(u[1], u[2])), np.arctan2(u[1], u[2])]
    )
    return scale, angles_rad


def inverse_lower(matrix: Floats) -> Floats:
    """Return the inverse, lower triangular, of a lower-triangular 3 x 3 matrix by forward substitution."""
    (a, _, _), (d, b, _), (f, e, c) = matrix
    return np.array(
        [[1 / a, 0.0, 0.0], [-d / (a * b), 1 / b, 0.0], [(d * e - b * f) / (a * b * c), -e / (b * c), 1 / c]]
    )


def lower_triangular_gauge(matrix: ArrayLike) -> tuple[Floats, Floats]:
    """Return T_low, lower triangular with a positive diagonal, and R, orthogonal, such that ``matrix`` = T_low R.

    R takes the frame in which the field was given to the magnetometer's base frame; its determinant is -1 where the
    sensor is left-handed.
    """
    q, r = np.linalg.qr(np.asarray(matrix, dtype=np.float64).T)
    signs = np.where(np.diag(r) < 0, -1.0, 1.0)
    return (r * signs[:, None]).T, (q * signs).T


# ---------------------------------------------------------------------------------------------------- conventions
