"""Programmed turns: the attitude that the body shall have, and how fast it shall turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import multiply
from magcal_core.errors import InputError


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn from the orbital axes to fixed angles: at once, or along a quintic ramp that starts and ends at rest.

    Attributes
    ----------
    angles_rad : (psi, theta, gamma)
        Where the turn ends, rad.
    ramp_s : float
        Duration of the ramp, s; 0 for a step.

    Raises
    ------
    InputError
        An angle is not finite, or the ramp is negative.
    """

    angles_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ramp_s: float = 0.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.angles_rad)) or not (0.0 <= self.ramp_s < np.inf):
            raise InputError("the angles of a turn must be finite, its ramp finite and not negative")

    def fraction(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Return how much of the turn is done, 0 to 1, and its rate, 1/s, each of shape (n,)."""
        if self.ramp_s == 0.0:
            return np.ones_like(t_s), np.zeros_like(t_s)
        x = np.clip(t_s / self.ramp_s, 0.0, 1.0)
        return x**3 * (10.0 - 15.0 * x + 6.0 * x * x), 30.0 * (x * (1.0 - x)) ** 2 / self.ramp_s

    def attitude(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Return the quaternions from orbital to programmed axes, shape (n, 4), and w_p, shape (n, 3), rad/s.

        Notes
        -----
        (2.3): ``w_p = P_gamma P_theta (0, psi', 0) + P_gamma (0, 0, theta') + (gamma', 0, 0)``, in programmed axes
        (`docs/references.md`: ROM).
        """
        done, rate = self.fraction(t_s)
        psi, theta, gamma = (angle * done for angle in self.angles_rad)
        d_psi, d_theta, d_gamma = (angle * rate for angle in self.angles_rad)
        q = multiply(multiply(_about(psi, 2), _about(theta, 3)), _about(gamma, 1))
        ct, st, cg, sg = np.cos(theta), np.sin(theta), np.cos(gamma), np.sin(gamma)
        w_p = np.stack([st * d_psi + d_gamma, cg * ct * d_psi + sg * d_theta, -sg * ct * d_psi + cg * d_theta], axis=-1)
        return q, w_p


def _about(angle_rad: Floats, component: int) -> Floats:
    """Return the quaternions of turns about one axis; ``component`` 1, 2, 3 for X, Y, Z."""
    q = np.zeros((*angle_rad.shape, 4))
    q[..., 0], q[..., component] = np.cos(0.5 * angle_rad), np.sin(0.5 * angle_rad)
    return q
