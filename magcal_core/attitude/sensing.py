"""What the control law gets to see: the magnetometer with all its errors, corrected or not, and the gyros."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import euler_matrix
from magcal_core.errors import InputError

if TYPE_CHECKING:
    from magcal_core.sensor.model import SensorModel

Triple = tuple[float, float, float]

_NONE: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Magnetometer:
    """A three-axis magnetometer along the body axes.

    Attributes
    ----------
    eps_rad : (e1, e2, e3)
        Non-orthogonality of (4.1), first order, rad: M_eps has the rows (1, 0, 0), (e1, 1, 0), (e2, e3, 1).
    mounting_rad : (psi, theta, gamma)
        Mounting error of the sensor block, rad.
    model_error_nt : shape (3,)
        mu: error that the on-board model has beside that of its own coefficients, orbital axes, nT.
    common_scale : float
        alpha: error of the scale that all axes share; it cancels in the normalisation.
    bias_nt : shape (3,)
        Zero offset 0_I, nT.
    noise_nt : float
        White noise of each reading and axis, 1 sigma, nT.
    sensor : SensorModel, optional
        Full model ``h = T B + b`` on top of the terms of (4.1); without it T = I, b = 0.
    corrected_with : SensorModel, optional
        Parameters by which the readings are corrected on board; without them the law gets raw readings.

    Raises
    ------
    InputError
        A term is not finite, the noise is negative, or the common scale turns the reading round.

    Notes
    -----
    ``A = M_eps M_psi,theta,gamma B (1 + alpha) + 0_I`` (`docs/references.md`: ROM, 4.1); mu, which (4.1) adds to B, is
    added to the on-board model: to first order only its sign differs.
    """

    eps_rad: Triple = _NONE
    mounting_rad: Triple = _NONE
    model_error_nt: Triple = _NONE
    common_scale: float = 0.0
    bias_nt: Triple = _NONE
    noise_nt: float = 0.0
    sensor: SensorModel | None = None
    corrected_with: SensorModel | None = None

    def __post_init__(self) -> None:
        terms = (*self.eps_rad, *self.mounting_rad, *self.model_error_nt, *self.bias_nt, self.common_scale)
        if not np.all(np.isfinite(terms)) or not self.noise_nt >= 0.0 or not self.common_scale > -1.0:
            raise InputError("magnetometer terms must be finite, the noise not negative, the common scale above -1")

    @property
    def correction(self) -> Floats:
        """Matrix that the on-board correction applies to a reading, shape (3, 3)."""
        return np.eye(3) if self.corrected_with is None else self.corrected_with.correction_matrix

    @property
    def matrix(self) -> Floats:
        """Matrix from the field in body axes to what the control law gets, shape (3, 3)."""
        e1, e2, e3 = self.eps_rad
        m_eps = np.array([[1.0, 0.0, 0.0], [e1, 1.0, 0.0], [e2, e3, 1.0]])
        terms = (1.0 + self.common_scale) * m_eps @ euler_matrix(*self.mounting_rad)
        own = np.eye(3) if self.sensor is None else self.sensor.matrix
        whole: Floats = self.correction @ own @ terms
        return whole

    @property
    def offset_nt(self) -> Floats:
        """Constant part of what the control law gets, shape (3,), body axes, nT."""
        own = 0.0 if self.sensor is None else np.asarray(self.sensor.bias_nt)
        removed = 0.0 if self.corrected_with is None else np.asarray(self.corrected_with.bias_nt)
        offset: Floats = self.correction @ (np.asarray(self.bias_nt) + own - removed)
        return offset

    def noise(self, generator: np.random.Generator, n: int) -> Floats:
        """Return the noise in what the control law gets, shape (n, 3), body axes, nT."""
        drawn: Floats = generator.normal(scale=self.noise_nt, size=(n, 3)) @ self.correction.T
        return drawn


@dataclass(frozen=True, slots=True)
class Gyro:
    """Three rate gyros along the body axes: a constant bias and white noise at each control step, rad/s.

    Raises
    ------
    InputError
        A bias is not finite, or the noise is negative.
    """

    bias_rad_s: Triple = _NONE
    noise_rad_s: float = 0.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.bias_rad_s)) or not self.noise_rad_s >= 0.0:
            raise InputError("the gyro bias must be finite and its noise not negative")

    def error(self, generator: np.random.Generator, n: int) -> Floats:
        """Return measured minus true rate, shape (n, 3), body axes, rad/s."""
        drawn: Floats = np.asarray(self.bias_rad_s) + generator.normal(scale=self.noise_rad_s, size=(n, 3))
        return drawn
