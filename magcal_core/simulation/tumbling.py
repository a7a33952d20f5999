"""Torque-free motion of a rigid body, in closed form: any number of instants at once, no error that grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ellipj, ellipk, ellipkinc

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import conjugate, from_rotation_vector, multiply, unit
from magcal_core.errors import OptionError

_NODES: Final = 4096
"""Instants over one period at which the rate of the precession is sampled."""
_NEGLIGIBLE_RAD: Final = 1e-13
"""Amplitude below which a harmonic of the precession is dropped."""
_SEPARATRIX: Final = 1e-8
"""Distance of the elliptic parameter from 1 below which the motion has no usable period."""
_CONSTANT: Final = 1e-14
"""Sine of the angle between rate and momentum below which the body spins about a principal axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Tumbling:
    """A rigid body that no torque acts on.

    Attributes
    ----------
    moments : shape (3,)
        Principal moments of inertia along the body axes, in any unit.
    rate_rad_s : shape (3,)
        Angular rate at the epoch, rad/s, body axes.
    q0 : shape (4,)
        Attitude at the epoch: unit quaternion, scalar first, inertial to body axes.

    Raises
    ------
    OptionError
        The moments are not those of a body.
    """

    moments: Floats
    rate_rad_s: Floats
    q0: Floats

    def __post_init__(self) -> None:
        for name, size in (("moments", 3), ("rate_rad_s", 3), ("q0", 4)):
            value = np.array(getattr(self, name), np.float64)
            object.__setattr__(self, name, value)
            if value.shape != (size,) or not np.isfinite(value).all():
                raise OptionError(f"{name}: want {size} finite numbers")
        if self.moments.min() <= 0 or 2 * self.moments.max() > self.moments.sum() * (1 + 1e-9):
            raise OptionError("moments of inertia: each must be positive and at most the sum of the other two")

    def motion(self, t_s: ArrayLike) -> tuple[Floats, Floats]:
        """Return attitudes, shape (n, 4), and body rates, shape (n, 3), rad/s, ``t_s`` seconds after the epoch.

        Raises
        ------
        OptionError
            The motion runs along the separatrix, where it has no period.

        Notes
        -----
        The angular momentum l is fixed in inertial axes. In body axes it moves with Jacobi's elliptic functions; about
        l the body turns by Euler's angles 3-1-3. Two of them are the direction of l; the third is the integral of
        |l| (Ia wa^2 + Ib wb^2) / ((Ia wa)^2 + (Ib wb)^2): a steady part and a periodic one, taken from its Fourier
        series (`docs/references.md`: LANDAU). The third Euler axis is the one that l never points along.
        """
        t = np.asarray(t_s, np.float64)
        momentum = self.moments * self.rate_rad_s
        size = np.linalg.norm(momentum) * np.linalg.norm(self.rate_rad_s)
        if np.linalg.norm(np.cross(self.rate_rad_s, momentum)) <= _CONSTANT * size:
            turns = from_rotation_vector(t[:, None] * self.rate_rad_s)
            return multiply(np.broadcast_to(unit(self.q0), turns.shape), turns), np.tile(self.rate_rad_s, (t.size, 1))
        nutation = _nutation(self.moments, self.rate_rad_s)
        rate = nutation.rate(t)
        at_epoch = _euler_quaternion(momentum[None], np.zeros(1), nutation.axes[0])
        from_momentum = multiply(unit(self.q0), conjugate(at_epoch[0]))
        euler = _euler_quaternion(self.moments * rate, nutation.precession_rad(t), nutation.axes[0])
        return unit(multiply(np.broadcast_to(from_momentum, euler.shape), euler)), rate


@dataclass(frozen=True, slots=True, eq=False)
class _Nutation:
    """The body rate along its axes: amplitudes times (cn, sn, dn) of phase + pace t.

    The momentum never points along ``axes[0]`` and circles ``axes[2]``.
    """

    moments: Floats
    axes: tuple[int, int, int]
    amplitudes: Floats
    parameter: float
    pace_per_s: float
    phase: float

    def rate(self, t_s: Floats) -> Floats:
        """Return the body rate, shape (n, 3), rad/s."""
        return self._rate_at(self.phase + self.pace_per_s * t_s)

    def _rate_at(self, argument: Floats) -> Floats:
        period = 4.0 * ellipk(self.parameter)
        sn, cn, dn, _ = ellipj(np.remainder(argument, period), self.parameter)
        rate = np.empty((argument.size, 3))
        for axis, amplitude, function in zip(self.axes, self.amplitudes, (cn, sn, dn), strict=True):
            rate[:, axis] = amplitude * function
        return rate

    def precession_rad(self, t_s: Floats) -> Floats:
        """Return the angle of precession since the epoch, shape (n,), rad."""
        half_period = 2.0 * ellipk(self.parameter)
        rate = self._rate_at(half_period * np.arange(_NODES) / _NODES)
        momentum = self.moments * rate
        a, b = ((self.axes[0] + i) % 3 for i in (1, 2))
        size = np.linalg.norm(momentum[0])
        across = momentum[:, a] ** 2 + momentum[:, b] ** 2
        speed = size * (momentum[:, a] * rate[:, a] + momentum[:, b] * rate[:, b]) / across
        series = np.fft.rfft(speed) / _NODES
        frequency = 2.0 * np.pi / half_period
        angle = series[0].real * t_s
        place = frequency * np.remainder(self.phase + self.pace_per_s * t_s, half_period)
        at_epoch = frequency * self.phase
        for n in range(1, _NODES // 2):
            wave = 2.0 * series[n] / (1j * n * frequency * self.pace_per_s)
            if abs(wave) > _NEGLIGIBLE_RAD:
                angle += wave.real * (np.cos(n * place) - np.cos(n * at_epoch))
                angle -= wave.imag * (np.sin(n * place) - np.sin(n * at_epoch))
        return np.asarray(angle)


def _nutation(moments: Floats, rate: Floats) -> _Nutation:
    order = np.argsort(moments, kind="stable")
    if np.sum((moments * rate) ** 2) < np.sum(moments * rate**2) * moments[order[1]]:
        order = order[::-1]
    i1, i2, i3 = (float(value) for value in moments[order])
    w1, w2, w3 = (float(value) for value in rate[order])
    # Energy times i3 less momentum squared, and the other way round with i1: as sums, which keep their digits.
    off = i1 * (i3 - i1) * w1**2 + i2 * (i3 - i2) * w2**2
    along = i2 * (i2 - i1) * w2**2 + i3 * (i3 - i1) * w3**2
    steep = (i3 - i2) * along
    parameter = (i2 - i1) * off / steep if steep else np.inf
    if not 0.0 <= parameter < 1.0 - _SEPARATRIX:
        raise OptionError("the rate lies on the separatrix of the tumbling motion; choose another one")
    a1, a2 = np.sqrt(off / (i1 * (i3 - i1))), np.sqrt(off / (i2 * (i3 - i2)))
    a3 = np.copysign(np.sqrt(along / (i3 * (i3 - i1))), w3)
    handedness = 1.0 if (order[1] - order[0]) % 3 == 1 else -1.0
    pace = handedness * np.sign(i3 - i2) * np.sign(a3) * np.sqrt(steep / (i1 * i2 * i3))
    phase = float(ellipkinc(np.arctan2(w2 / a2, w1 / a1), parameter))
    axes = (int(order[0]), int(order[1]), int(order[2]))
    return _Nutation(moments, axes, np.array([a1, a2, a3]), float(parameter), float(pace), phase)


def _euler_quaternion(momentum: Floats, precession_rad: Floats, third: int) -> Floats:
    """Return the attitudes, shape (n, 4), of 3-1-3 turns whose third axis is ``third``, from the momentum's axes."""
    a, b = (third + 1) % 3, (third + 2) % 3
    half_nutation = 0.5 * np.arctan2(np.hypot(momentum[:, a], momentum[:, b]), momentum[:, third])
    spin = np.arctan2(momentum[:, a], momentum[:, b])
    both, apart = 0.5 * (precession_rad + spin), 0.5 * (precession_rad - spin)
    q = np.empty((len(momentum), 4))
    q[:, 0] = np.cos(half_nutation) * np.cos(both)
    q[:, 1 + a] = np.sin(half_nutation) * np.cos(apart)
    q[:, 1 + b] = np.sin(half_nutation) * np.sin(apart)
    q[:, 1 + third] = np.cos(half_nutation) * np.sin(both)
    return q
