"""Gains of ROM: why the loop converges, where it stops doing so, and which gains suit an orbit and a body.

Linearised about the programmed attitude, with phi the error, b the field direction in orbital axes, tau = kd / kp:
``phi' = -(1 / tau) (I - b b^T) phi + (b . phi) (b x w_o)``. The turn of b is what makes the rotation about it visible.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.attitude.circular import CircularOrbit
from magcal_core.attitude.plant import Body
from magcal_core.attitude.scenario import Gains
from magcal_core.errors import InputError
from magcal_core.field import FieldModel

STABLE_DAMPING_RATIO: Final = 0.5
"""Below it the rotation about the field grows."""
PROPOSED_DAMPING_RATIO: Final = 1.0
"""Least damping ratio of gains that `propose_gains` proposes: twice the limit."""
TAU_RANGE_S: Final = (60.0, 3000.0)
"""Range in which `propose_gains` looks for tau, s."""
_NEVER: Final = 1e-7
"""Relative decay in one orbit below which a mode counts as not converging."""


def damping_ratio(gains: Gains, moment_kg_m2: float) -> float:
    """Return zeta = kd / (2 sqrt(2 J kp)) of an axis with this moment of inertia; the loop is stable above 0.5."""
    return gains.kd_nms / (2.0 * float(np.sqrt(2.0 * moment_kg_m2 * gains.kp_nm)))


def field_turning(orbit: CircularOrbit, field: FieldModel, orbits: int = 1) -> float:
    """Return <b' . b'_i>, rad2/s2, over ``orbits``: b' the rate of the field direction in orbital axes, b'_i inertial.

    Notes
    -----
    1.92 n^2 at 62 deg and 2.25 n^2 at 90 deg for the direct dipole, 0 on the equator (`docs/references.md`: ROM).
    """
    t_s: Floats = np.arange(2000.0 * orbits) * (orbit.period_s / 2000)
    step_s = 0.5
    before, now, after = (_direction(orbit, field, t_s + shift) for shift in (-step_s, 0.0, step_s))
    b_rate = (after - before) / (2.0 * step_s)
    inertial = b_rate + np.cross(np.array([0.0, 0.0, -orbit.rate_rad_s]), now)
    return float(np.mean(np.sum(b_rate * inertial, axis=-1)))


def growth_rate_per_s(turning_rad2_s2: float, gains: Gains, moment_kg_m2: float) -> float:
    """Return the rate, 1/s, at which a rotation about the field grows; negative where the loop converges.

    Notes
    -----
    ``chi' = -(tau - 2 J / kd) <b' . b'_i> chi``, for tau n up to 0.3; ``turning_rad2_s2`` is `field_turning`.
    """
    return -(gains.tau_s - 2.0 * moment_kg_m2 / gains.kd_nms) * turning_rad2_s2


def efold_s(
    orbit: CircularOrbit, field: FieldModel, tau_s: NDArray[np.float64], *, orbits: int = 1, steps: int = 1500
) -> Floats:
    """Return the time in which the slowest mode falls by e, s, shape (m,), for each tau, s, shape (m,); inf if never.

    The inertia is neglected. One orbit is a period of the dipole's field; take 15 ``orbits``, a day, for others.

    Notes
    -----
    Eigenvalues of the transition matrix of the linearised loop, integrated by Runge-Kutta (Floquet's theorem).

    Raises
    ------
    InputError
        A time constant is not positive, or shorter than two integration steps.
    """
    tau = np.atleast_1d(np.asarray(tau_s, dtype=np.float64))
    n = steps * orbits
    step_s = orbits * orbit.period_s / n
    if not np.all(tau > 2.0 * step_s):
        raise InputError(f"tau must be above {2.0 * step_s:.1f} s with {steps} steps an orbit")
    half_steps_s: Floats = np.arange(2.0 * n + 1.0) * (0.5 * step_s)
    b = _direction(orbit, field, half_steps_s)
    across = np.eye(3) - b[:, :, None] * b[:, None, :]
    drift = np.cross(b, np.array([0.0, 0.0, -orbit.rate_rad_s]))[:, :, None] * b[:, None, :]

    def slope(k: int, x: Floats) -> Floats:
        rate: Floats = (drift[k] - across[k] / tau[:, None, None]) @ x
        return rate

    transition: Floats = np.broadcast_to(np.eye(3), (tau.size, 3, 3)).copy()
    for k in range(0, 2 * n, 2):
        k1 = slope(k, transition)
        k2 = slope(k + 1, transition + 0.5 * step_s * k1)
        k3 = slope(k + 1, transition + 0.5 * step_s * k2)
        k4 = slope(k + 2, transition + step_s * k3)
        transition = transition + (step_s / 6.0) * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    decay = -np.log(np.abs(np.linalg.eigvals(transition)).max(axis=-1))
    slowest: Floats = np.where(decay > _NEVER * orbits, orbits * orbit.period_s / np.maximum(decay, _NEVER), np.inf)
    return slowest


@dataclass(frozen=True, slots=True)
class GainProposal:
    """Gains for an orbit and a body, and what may be expected of them.

    ``efold_s`` is inf where the field does not show the rotation about it, as the dipole on the equator:
    then no gains make the attitude converge.
    """

    gains: Gains
    tau_s: float
    efold_s: float
    damping_ratio: float

    @property
    def converges(self) -> bool:
        """Whether the whole attitude converges on this orbit."""
        return bool(np.isfinite(self.efold_s))

    def to_dict(self) -> dict[str, object]:
        """Return the proposal for records, the time None where nothing converges."""
        return {
            "kp_nm": self.gains.kp_nm,
            "kd_nms": self.gains.kd_nms,
            "tau_s": self.tau_s,
            "efold_s": self.efold_s if self.converges else None,
            "damping_ratio": self.damping_ratio,
        }


def propose_gains(
    orbit: CircularOrbit, body: Body, field: FieldModel, *, dt_s: float = 0.5, orbits: int = 1
) -> GainProposal:
    """Return gains with which the attitude converges fastest that the wheels and the control period allow.

    tau is the one with the shortest e-fold on this orbit, kp the wheels' torque limit, so that no error of attitude
    alone saturates them and disturbances turn the body least; kp is less where the control period asks for it.
    ``orbits`` as in `efold_s`: 1 for the dipole, 15 for others.

    Raises
    ------
    InputError
        No tau up to 3000 s gives this body a damping ratio of 1: the wheels are too weak for its inertia.

    Notes
    -----
    ``kd dt / J <= 1`` keeps the sampled loop well damped; ``zeta >= 1`` is twice the limit of stability. The inertia
    acts as a tau shorter by 2 J / kd, as in `growth_rate_per_s`.
    """
    moments = np.linalg.eigvalsh(body.inertia_kg_m2)
    tau = np.geomspace(*TAU_RANGE_S, 120)
    kp = np.minimum(body.torque_limit_nm, moments[0] / (tau * dt_s))
    zeta = tau * np.sqrt(kp) / (2.0 * np.sqrt(2.0 * moments[2]))
    usable = zeta >= PROPOSED_DAMPING_RATIO
    if not usable.any():
        raise InputError(
            f"wheels of {body.torque_limit_nm} Nm are too weak for {moments[2]:.4g} kg m2: the damping ratio is "
            f"{zeta.max():.2f} at most with tau up to {TAU_RANGE_S[1]:.0f} s, want {PROPOSED_DAMPING_RATIO}"
        )
    effective_s = tau - 2.0 * moments.mean() / (kp * tau)
    slowest = np.full(tau.size, np.inf)
    slowest[usable] = efold_s(orbit, field, effective_s[usable], orbits=orbits, steps=400)
    best = int(np.argmin(slowest)) if np.isfinite(slowest).any() else int(np.flatnonzero(usable)[0])
    gains = Gains(float(kp[best]), float(kp[best] * tau[best]))
    return GainProposal(gains, float(tau[best]), float(slowest[best]), damping_ratio(gains, float(moments[2])))


def _direction(orbit: CircularOrbit, field: FieldModel, t_s: Floats) -> Floats:
    """Return the unit vectors along the field, shape (n, 3), orbital axes."""
    b_osk_nt = orbit.field_osk_nt(field, t_s)
    unit: Floats = b_osk_nt / np.linalg.norm(b_osk_nt, axis=-1, keepdims=True)
    return unit
