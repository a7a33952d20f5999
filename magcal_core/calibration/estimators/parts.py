"""What only some methods find beside the parameters: parts of a fit, each with a type of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats

MISALIGNED_P: Final = 1e-6
"""Probability below which the lower-triangular hypothesis is given up."""
MISALIGNED_DEG: Final = 0.1
"""Rotation below which a misalignment is not worth a warning, deg."""


@dataclass(frozen=True, slots=True, eq=False)
class FullMatrix:
    """The twelve-parameter fit: T with all nine elements, and the test that the three above the diagonal are zero.

    Attributes
    ----------
    matrix : shape (3, 3)
        T of h = T B + b.
    f_statistic, p_value : float
        Of the hypothesis T12 = T13 = T23 = 0, with 3 degrees of freedom.
    lower, rotation : shape (3, 3)
        T = lower rotation: the rotation takes the reference's frame to the magnetometer's base frame.
    is_regular : bool
        Whether all three axes respond.
    """

    matrix: Floats
    f_statistic: float
    p_value: float
    lower: Floats
    rotation: Floats
    is_regular: bool

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation between the reference's frame and the magnetometer's base frame, deg."""
        proper = self.rotation * np.sign(np.linalg.det(self.rotation))
        return float(np.rad2deg(np.arccos(np.clip((np.trace(proper) - 1.0) / 2.0, -1.0, 1.0))))

    @property
    def is_misaligned(self) -> bool:
        """Whether the test finds that the reference is not in the sensor's own base frame."""
        return self.p_value < MISALIGNED_P and self.angle_deg >= MISALIGNED_DEG

    @property
    def warnings(self) -> tuple[str, ...]:
        """Say that the reference is not in the sensor's own base frame, where the test finds so."""
        if not self.is_misaligned:
            return ()
        return (
            f"misaligned: the reference is turned by {self.angle_deg:.2f} deg from the sensor's base frame "
            f"(p = {self.p_value:.1g}); full_matrix has the rotation",
        )

    def to_dict(self) -> dict[str, object]:
        """Return the fit as the records have it."""
        return {
            "matrix": self.matrix.tolist(),
            "f_statistic": self.f_statistic,
            "p_value": self.p_value,
            "lower_triangular": self.lower.tolist(),
            "rotation": self.rotation.tolist(),
            "rotation_deg": self.angle_deg,
        }


@dataclass(frozen=True, slots=True, eq=False)
class FirstOrder:
    """The parameters of the DEKART paper's first-order A, and the residual as that paper gives it.

    Attributes
    ----------
    bias_nt, scale, nonorthogonality_deg : shape (3,)
        In the paper's own convention.
    mean_nt, sigma_nt : float
        Mean and standard deviation of |model| - |corrected|, nT.
    evaluations : int
        Of the cost, until the search ended.
    """

    bias_nt: Floats
    scale: Floats
    nonorthogonality_deg: Floats
    mean_nt: float
    sigma_nt: float
    evaluations: int

    def to_dict(self) -> dict[str, object]:
        """Return the parameters as the records have them."""
        return {
            "bias_nt": self.bias_nt.tolist(),
            "scale": self.scale.tolist(),
            "nonorthogonality_deg": self.nonorthogonality_deg.tolist(),
            "mean_nt": self.mean_nt,
            "sigma_nt": self.sigma_nt,
            "evaluations": self.evaluations,
        }
