"""The reference of a sensor that averages: the mean, in the sensor's frame, of the field over its integration time.

Notes
-----
Over T seconds about the time stamp a body turns with the rate w + a s, s seconds after the stamp, so that a field B
that stays where it is in inertial axes becomes B(s) with B' = -(w + a s) x B. Its mean is, with a = 0 exactly,

    <B> = u (u . B) + sinc(|w| T / 2) (B - u (u . B)),  u = w / |w|,  sinc x = sin x / x,

and a change of the rate adds -(T^2 / 24) a x B to it. The stamp is the middle of the interval: at its beginning or end
the part across the axis would be turned by |w| T / 2 as well. What the field itself changes along the orbit within the
interval is left out: up to 1.3 nT of a component at T = 10 s, 47 nT at 60 s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.attitude.rotation import conjugate, multiply
from magcal_core.numerics.vectors import lengths
from magcal_core.samples import Samples

QUATERNIONS: Final = "quaternions"
GYROS: Final = "gyros"
MAX_STEP_S: Final = 10.0
"""Longest time between two attitudes, s, from which a rate is told."""
MAX_TURN_RAD: Final = np.pi / 2.0
"""Largest turn between two attitudes: one of three quarters would look like a quarter the other way round."""
_NORM: Final = 1e-2
"""How far the norm of a quaternion may be from 1."""

Rows = NDArray[np.bool_] | NDArray[np.intp] | slice


@dataclass(frozen=True, slots=True, eq=False)
class BodyRate:
    """How the magnetometer's base frame turns at each sample.

    Attributes
    ----------
    source : `QUATERNIONS` or `GYROS`.
    rate_rad_s : shape (n, 3)
        Angular rate in inertial space, base frame, rad/s; NaN where it is not known.
    change_rad_s2 : shape (n, 3)
        Its derivative, rad/s^2; zero where it is not known.
    """

    source: str
    rate_rad_s: Floats
    change_rad_s2: Floats

    @classmethod
    def of_attitude(cls, t_utc: Times, q_base_gcrf: Floats | None) -> BodyRate:
        """Return the rate by the differences of neighbouring attitudes, shape (n, 4), at ascending ``t_utc``.

        It is known where one of a sample's two neighbours is at most `MAX_STEP_S` away and turned by at most
        `MAX_TURN_RAD`; its change where both are.
        """
        n = len(t_utc)
        rate, change = np.full((n, 3), np.nan), np.zeros((n, 3))
        rows = np.zeros(0, np.intp) if q_base_gcrf is None else _oriented(q_base_gcrf)
        if q_base_gcrf is None or len(rows) < 2:
            return cls(QUATERNIONS, rate, change)
        q, step_s = q_base_gcrf[rows], np.diff(t_utc[rows]) / np.timedelta64(1, "ns") * 1e-9
        turn_rad = rotation_vectors(multiply(conjugate(q[:-1]), q[1:]))
        is_told = (step_s > 0.0) & (step_s <= MAX_STEP_S) & (lengths(turn_rad) <= MAX_TURN_RAD)
        between = np.full((len(rows) + 1, 3), np.nan)
        between[1:-1][is_told] = turn_rad[is_told] / step_s[is_told, None]
        before, after = between[:-1], between[1:]
        before_s, after_s = np.append(1.0, step_s)[:, None], np.append(step_s, 1.0)[:, None]
        both = np.isfinite(before + after).all(axis=1)
        # Each step's mean rate is that of its middle: a line through both gives rate and change at the sample.
        with np.errstate(invalid="ignore"):
            line = (before * after_s + after * before_s) / (before_s + after_s)
            slope = 2.0 * (after - before) / (before_s + after_s)
        one = np.where(np.isfinite(before), before, after)
        rate[rows] = np.where(both[:, None], line, one)
        change[rows] = np.where(both[:, None], slope, 0.0)
        return cls(QUATERNIONS, rate, change)

    def take(self, rows: Rows) -> BodyRate:
        """Return the rate at the samples ``rows``."""
        return BodyRate(self.source, self.rate_rad_s[rows], self.change_rad_s2[rows])

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """At which samples there is a rate, shape (n,)."""
        return np.asarray(np.isfinite(self.rate_rad_s).all(axis=1))

    def mean_of(self, b_base_nt: Floats, integration_s: float) -> Floats:
        """Return the mean of the field over ``integration_s`` about each sample, shape (n, 3), nT, base frame.

        ``b_base_nt``: the field at the sample, shape (n, 3); it stays where no rate is known.
        """
        speed = lengths(self.rate_rad_s)[:, None]
        axis = self.rate_rad_s / np.where(speed > 0.0, speed, 1.0)
        kept = across_share(speed, integration_s)
        along_nt = np.sum(axis * b_base_nt, axis=1, keepdims=True) * axis
        turned_nt = integration_s**2 / 24.0 * np.cross(self.change_rad_s2, b_base_nt)
        mean_nt = along_nt + kept * (b_base_nt - along_nt) - turned_nt
        return np.where(self.is_known[:, None], mean_nt, b_base_nt)


@dataclass(frozen=True, slots=True, eq=False)
class Averaging:
    """What a sensor's integration time makes of the reference at each sample.

    Attributes
    ----------
    integration_s : s.
    rate : how the base frame turns.
    share : shape (n,)
        |<B>| over |B|; NaN where rate or direction is not known.
    """

    integration_s: float
    rate: BodyRate
    share: Floats

    @classmethod
    def of_components(cls, integration_s: float, rate: BodyRate, b_base_nt: Floats | None) -> Averaging:
        """Return what averaging makes of the field, shape (n, 3), base frame, nT; None where it is not known."""
        share = np.full(len(rate.rate_rad_s), np.nan)
        if b_base_nt is not None:
            known = rate.is_known & np.isfinite(b_base_nt).all(axis=1)
            mean_nt = rate.take(known).mean_of(b_base_nt[known], integration_s)
            share[known] = lengths(mean_nt) / lengths(b_base_nt[known])
        return cls(integration_s, rate, share)

    @classmethod
    def of_readings(cls, integration_s: float, rate: BodyRate, x_base_nt: Floats, b_nt: Floats) -> Averaging:
        """Return what averaging makes of |B|, shape (n,), nT, where readings tell the field's direction.

        ``x_base_nt``: corrected readings, shape (n, 3), base frame: along the axis of the turn they show the field as
        it is, across it is what is left of |B|.
        """
        speed = lengths(rate.rate_rad_s)
        axis = rate.rate_rad_s / np.where(speed > 0.0, speed, 1.0)[:, None]
        along = np.clip(np.sum(axis * x_base_nt, axis=1) / b_nt, -1.0, 1.0)
        return cls(integration_s, rate, np.sqrt(along**2 + across_share(speed, integration_s) ** 2 * (1.0 - along**2)))

    def take(self, rows: Rows) -> Averaging:
        """Return the same of the samples ``rows``."""
        return Averaging(self.integration_s, self.rate.take(rows), self.share[rows])

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """At which samples the reference is averaged, shape (n,)."""
        return np.asarray(np.isfinite(self.share))

    def of_reference(self, b_nt: Floats, b_base_nt: Floats | None) -> tuple[Floats, Floats | None]:
        """Return |<B>|, shape (n,), and <B>, shape (n, 3), of |B| and B, nT; what is not known stays."""
        if b_base_nt is None:
            return np.where(self.is_known, self.share, 1.0) * b_nt, None
        mean_nt = self.rate.mean_of(b_base_nt, self.integration_s)
        return np.where(self.is_known, lengths(mean_nt), b_nt), mean_nt

    def applied(self, samples: Samples) -> Samples:
        """Return ``samples`` with the mean in place of the field in their base frame and of its magnitude."""
        b_nt, b_base_nt = samples.b_ref_magnitude_nt, samples.b_ref_base_nt
        if b_nt is None:
            return samples
        mean_nt, mean_base_nt = self.of_reference(b_nt, b_base_nt)
        return replace(samples, b_ref_magnitude_nt=mean_nt, b_ref_base_nt=mean_base_nt)


def averaged_by_attitude(samples: Samples, integration_s: float | None) -> tuple[Samples, Averaging | None]:
    """Return ``samples``, in time order, with their reference as a sensor that averages reads it, and how.

    Without an ``integration_s`` they are as they were, and there is no averaging.
    """
    if not integration_s:
        return samples, None
    rate = BodyRate.of_attitude(samples.t_utc, samples.q_base_gcrf)
    averaging = Averaging.of_components(integration_s, rate, samples.b_ref_base_nt)
    return averaging.applied(samples), averaging


def across_share(speed_rad_s: Floats, integration_s: float) -> Floats:
    """Return what is left, of 1, of the field across the axis of a turn at ``speed_rad_s``, of any shape."""
    share: Floats = np.sinc(speed_rad_s * integration_s / (2.0 * np.pi))
    return share


def rotation_vectors(q: Floats) -> Floats:
    """Return the turns, shape (n, 3), rad, of at most half a turn each, of unit quaternions, shape (n, 4)."""
    size = lengths(q[:, 1:])
    sign = np.where(q[:, 0] < 0.0, -1.0, 1.0)
    angle_rad = 2.0 * np.arctan2(size, np.abs(q[:, 0]))
    per_size = np.divide(angle_rad, size, out=np.full(len(q), 2.0), where=size > 0.0)
    vectors: Floats = (sign * per_size)[:, None] * q[:, 1:]
    return vectors


def _oriented(q: Floats) -> NDArray[np.intp]:
    """Return the rows of quaternions, shape (n, 4), that are attitudes."""
    return np.flatnonzero(np.abs(np.linalg.norm(q, axis=1) - 1.0) < _NORM)
