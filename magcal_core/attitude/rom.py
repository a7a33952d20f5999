"""ROM: attitude restored and turned by magnetometer, gyros and wheels, simulated on a circular orbit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.attitude.law import DEGENERATE, GUARDED, Law, command
from magcal_core.attitude.plant import (
    Mechanics,
    State,
    Vector,
    advance,
    cross,
    dot,
    limited_torque,
    mechanics_of,
    product,
    times,
    turned,
)
from magcal_core.attitude.rotation import euler_matrix, quaternion_from_matrix, rotate
from magcal_core.attitude.scenario import RomScenario
from magcal_core.numerics.kernel import kernel

SETTLING_LEVELS_DEG: Final = (10, 5, 1)
"""Errors, deg, for which a result says when the attitude got below them for good."""


@dataclass(frozen=True, slots=True, eq=False)
class RomResult:
    """What became of the attitude, at every control step.

    Attributes
    ----------
    t_s : shape (n,)
        Time from the start, s.
    q : shape (n, 4)
        Attitude, orbital to body axes.
    error_deg : shape (n,)
        Total angle between the body and the programmed attitude, deg.
    rate_error_deg_s : shape (n,)
        Length of the difference between the body's rate and the programmed one, deg/s.
    wheel_momentum_nms, torque_nm : shape (n, 3)
        Momentum of the wheels, Nms, and torque on the body, Nm, body axes.
    smallest_q : float
        Smallest |q~| that the law met: near 0 the start lies near the degenerate set.
    period_s : float
        Orbital period, s.
    """

    t_s: Floats
    q: Floats
    error_deg: Floats
    rate_error_deg_s: Floats
    wheel_momentum_nms: Floats
    torque_nm: Floats
    smallest_q: float
    period_s: float

    def settling_s(self, level_deg: float) -> float | None:
        """Return the time after which the error stays below ``level_deg`` for good, s; None where it never does."""
        above: NDArray[np.intp] = np.flatnonzero(~(self.error_deg < level_deg))
        if above.size == 0:
            return float(self.t_s[0])
        after = above[-1] + 1
        return None if after == self.t_s.size else float(self.t_s[after])

    @property
    def in_last_two_orbits(self) -> NDArray[np.bool_]:
        """Steps within two orbits of the end, shape (n,); all of them in a shorter simulation."""
        return np.asarray(self.t_s >= self.t_s[-1] - 2.0 * self.period_s, dtype=np.bool_)

    def to_dict(self) -> dict[str, object]:
        """Return the summary as the records of the service have it."""
        last = self.in_last_two_orbits
        return {
            "settling_s": {str(level): self.settling_s(level) for level in SETTLING_LEVELS_DEG},
            "final_error_deg": float(self.error_deg[-1]),
            "max_error_last_two_orbits_deg": float(self.error_deg[last].max()),
            "max_rate_error_deg_s": float(self.rate_error_deg_s[last].max()),
            "wheel_momentum_max_nms": float(np.abs(self.wheel_momentum_nms).max()),
            "torque_max_nm": float(np.abs(self.torque_nm).max()),
            "smallest_q": self.smallest_q,
        }


@dataclass(frozen=True, slots=True, eq=False)
class FieldAlongOrbit:
    """True field and on-board model at the control steps, shape (n, 3), orbital axes, nT."""

    true_nt: Floats
    model_nt: Floats

    @classmethod
    def of(cls, scenario: RomScenario) -> FieldAlongOrbit:
        """Return the fields of a scenario; runs that differ in sensor or gains only may share them."""
        t_s = scenario.t_s
        true_nt = scenario.orbit.field_osk_nt(scenario.true_field, t_s)
        if scenario.onboard_field is None:
            return cls(true_nt, true_nt)
        return cls(true_nt, scenario.orbit.field_osk_nt(scenario.onboard_field, t_s))


def simulate_rom(scenario: RomScenario, along: FieldAlongOrbit | None = None) -> RomResult:
    """Return what the attitude does under the control law; ``along`` is `FieldAlongOrbit.of` of the scenario.

    Notes
    -----
    The law runs once a control period; its torque is held until the next (`docs/references.md`: ROM).

    Raises
    ------
    ModelRangeError
        The field model does not reach to this orbit or time.
    """
    t_s = scenario.t_s
    along = FieldAlongOrbit.of(scenario) if along is None else along
    rate_rad_s, body, gains = scenario.orbit.rate_rad_s, scenario.body, scenario.gains
    guard = GUARDED if scenario.is_guarded else DEGENERATE
    series, smallest_q = _fly(
        _start(scenario),
        Law(gains.kp_nm, gains.kd_nms, rate_rad_s, scenario.form == "printed", guard),
        mechanics_of(body, rate_rad_s),
        Wheels(body.torque_limit_nm, body.momentum_limit_nms, scenario.has_feed_forward, scenario.dt_s),
        _seen(scenario, along),
    )
    return RomResult(
        t_s=t_s,
        q=series[:, 0:4],
        error_deg=np.rad2deg(series[:, 10]),
        rate_error_deg_s=np.rad2deg(series[:, 11]),
        wheel_momentum_nms=series[:, 4:7],
        torque_nm=series[:, 7:10],
        smallest_q=float(smallest_q),
        period_s=scenario.orbit.period_s,
    )


class Wheels(NamedTuple):
    """Limits of the wheels, Nm and Nms, whether they take up the gyroscopic torque, and the control period, s."""

    torque_limit: float
    momentum_limit: float
    has_feed_forward: bool
    dt: float


class Seen(NamedTuple):
    """What the law works with at each step: field direction is ``matrix @ C b_true + offset`` against ``b_model``."""

    b_true: Floats
    matrix: Floats
    offset: Floats
    b_model: Floats
    gyro_error: Floats
    programme: Floats
    programme_rate: Floats


def _start(scenario: RomScenario) -> State:
    """Return attitude, rate and wheel momentum at the start."""
    q = quaternion_from_matrix(euler_matrix(*scenario.start_rad))
    w_o = np.array([0.0, 0.0, -scenario.orbit.rate_rad_s])
    w = {"inertial": np.zeros(3), "orbital": rotate(q, w_o), "body": w_o}[scenario.start_rate]
    return (
        (float(q[0]), float(q[1]), float(q[2]), float(q[3])),
        (float(w[0]), float(w[1]), float(w[2])),
        (0.0, 0.0, 0.0),
    )


def _seen(scenario: RomScenario, along: FieldAlongOrbit) -> Seen:
    """Return the tables that the compiled loop reads, the noise of all steps drawn."""
    t_s, magnetometer = scenario.t_s, scenario.magnetometer
    generator = np.random.default_rng(scenario.seed)
    programme, programme_rate = scenario.turn.attitude(t_s)
    return Seen(
        b_true=along.true_nt,
        matrix=magnetometer.matrix,
        offset=magnetometer.offset_nt + magnetometer.noise(generator, t_s.size),
        b_model=along.model_nt + np.asarray(magnetometer.model_error_nt),
        gyro_error=scenario.gyro.error(generator, t_s.size),
        programme=programme,
        programme_rate=programme_rate,
    )


@kernel()
def _row(table: Floats, k: int) -> Vector:
    """Return row k of a table, shape (n, 3)."""
    return (table[k, 0], table[k, 1], table[k, 2])


@kernel()
def _direction(v: Vector) -> Vector:
    """Return the unit vector along v."""
    length = np.sqrt(dot(v, v))
    return (v[0] / length, v[1] / length, v[2] / length)


@kernel()
def _minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel()
def _plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel()
def _fly(state: State, law: Law, mechanics: Mechanics, wheels: Wheels, seen: Seen) -> tuple[Floats, float]:
    """Return q, h, torque, error, rad, and rate error, rad/s, at every step, shape (n, 12), and the smallest |q~|."""
    n = seen.b_true.shape[0]
    series = np.empty((n, 12))
    smallest = 2.0
    for k in range(n):
        q, w, h = state
        p = (seen.programme[k, 0], seen.programme[k, 1], seen.programme[k, 2], seen.programme[k, 3])
        p_rate = _row(seen.programme_rate, k)
        alpha = _direction(_plus(times(seen.matrix, turned(q, _row(seen.b_true, k))), _row(seen.offset, k)))
        rate = _plus(w, _row(seen.gyro_error, k))
        torque, length = command(law, alpha, _direction(_row(seen.b_model, k)), rate, (p, p_rate))
        smallest = min(smallest, length)
        if wheels.has_feed_forward:
            torque = _plus(torque, cross(rate, _plus(times(mechanics.inertia, rate), h)))
        torque = limited_torque(torque, h, wheels.torque_limit, wheels.momentum_limit, wheels.dt)
        off = product((p[0], -p[1], -p[2], -p[3]), q)
        wanted = _plus(turned(q, (0.0, 0.0, -law.orbital_rate)), turned(off, p_rate))
        rate_error = _minus(w, wanted)
        series[k, 0], series[k, 1], series[k, 2], series[k, 3] = q
        series[k, 4], series[k, 5], series[k, 6] = h
        series[k, 7], series[k, 8], series[k, 9] = torque
        v = (off[1], off[2], off[3])
        series[k, 10] = 2.0 * np.arctan2(np.sqrt(dot(v, v)), abs(off[0]))
        series[k, 11] = np.sqrt(dot(rate_error, rate_error))
        state = advance(state, torque, mechanics, wheels.dt)
    return series, smallest
