"""What one simulation of ROM depends on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal, get_args

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.circular import CircularOrbit
from magcal_core.attitude.plant import Body
from magcal_core.attitude.programme import Turn
from magcal_core.attitude.sensing import Gyro, Magnetometer
from magcal_core.errors import InputError
from magcal_core.field import FieldModel

Form = Literal["corrected", "printed"]
StartRate = Literal["inertial", "orbital", "body"]

MAX_STEPS: Final = 1_000_000
"""Largest number of control steps of one simulation."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the control law: kp, Nm, and kd, Nms."""

    kp_nm: float = 0.05
    kd_nms: float = 20.0

    def __post_init__(self) -> None:
        if not (0.0 < self.kp_nm < np.inf and 0.0 < self.kd_nms < np.inf):
            raise InputError(f"gains must be positive and finite, not kp {self.kp_nm} Nm and kd {self.kd_nms} Nms")

    @property
    def tau_s(self) -> float:
        """Time constant kd / kp of the directions that the field shows, s."""
        return self.kd_nms / self.kp_nm


@dataclass(frozen=True, slots=True)
class RomScenario:
    """Everything that one simulation depends on.

    Attributes
    ----------
    true_field : FieldModel
        The true field.
    onboard_field : FieldModel, optional
        The model that the control law uses; without it the true one.
    start_rad : (psi, theta, gamma)
        Attitude at the start with respect to the orbital axes, rad.
    start_rate : {"inertial", "orbital", "body"}
        Rate at the start: none in inertial space (the paper's case), that of the orbital axes, or that of the orbital
        axes once body and orbital axes agree, (0, 0, -n) along the body axes. The wheels are at rest in each.
    form : {"corrected", "printed"}
        The control law with its errors corrected, or as the paper prints it.
    is_guarded : bool
        Whether the law turns away from the degenerate set, |q~| < 0.05, and not only where q~ vanishes.
    has_feed_forward : bool
        Whether the wheels also take up the gyroscopic torque w x (J w + h).
    duration_s, dt_s : float
        Length of the simulation and control period, s.
    seed : int
        Seed of the noise.

    Raises
    ------
    InputError
        A value is out of its range, or there are more than `MAX_STEPS` steps.
    """

    true_field: FieldModel
    orbit: CircularOrbit = field(default_factory=CircularOrbit)
    onboard_field: FieldModel | None = None
    body: Body = field(default_factory=Body)
    gains: Gains = field(default_factory=Gains)
    start_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_rate: StartRate = "inertial"
    turn: Turn = field(default_factory=Turn)
    magnetometer: Magnetometer = field(default_factory=Magnetometer)
    gyro: Gyro = field(default_factory=Gyro)
    form: Form = "corrected"
    is_guarded: bool = False
    has_feed_forward: bool = False
    duration_s: float = 10_000.0
    dt_s: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.start_rad)):
            raise InputError("the angles of the start must be finite")
        if self.form not in get_args(Form) or self.start_rate not in get_args(StartRate):
            raise InputError(f"unknown form {self.form!r} or start rate {self.start_rate!r}")
        if not (0.0 < self.dt_s <= self.duration_s < np.inf):
            raise InputError(
                f"duration {self.duration_s} s and control period {self.dt_s} s: want 0 < period <= duration"
            )
        if self.duration_s / self.dt_s > MAX_STEPS:
            raise InputError(f"{self.duration_s / self.dt_s:.0f} control steps; at most {MAX_STEPS}")

    @property
    def t_s(self) -> Floats:
        """Times of the control steps, s from the start, shape (n + 1,)."""
        steps = np.arange(round(self.duration_s / self.dt_s) + 1, dtype=np.float64)
        return steps * self.dt_s
