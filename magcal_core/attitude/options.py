"""What a user may ask of the attitude simulation, in the units of the edges, and the job that answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Final

import numpy as np

from magcal_core.attitude.circular import EPOCH_UTC, CircularOrbit
from magcal_core.attitude.gains import GainProposal, propose_gains
from magcal_core.attitude.option_values import OptionReader, Triple
from magcal_core.attitude.plant import INERTIA_KG_M2, Body, inertia_matrix
from magcal_core.attitude.programme import Turn
from magcal_core.attitude.rom import RomResult, simulate_rom
from magcal_core.attitude.scenario import Gains, RomScenario
from magcal_core.attitude.sensing import Gyro, Magnetometer
from magcal_core.errors import Fault, InputError, OptionError
from magcal_core.field import FieldModel
from magcal_core.field.models import field_model
from magcal_core.numerics.time_series import extreme_indices
from magcal_core.sensor.model import SensorModel

ALIASES: Final[Mapping[str, str]] = {"start": "start_deg", "turn": "turn_deg", "kp": "kp_nm", "kd": "kd_nms"}
"""Names of the command line's options that a job may use for those with a unit."""
ORBITS_A_DAY: Final = 15
"""Orbits over which gains are judged where the field is not that of the dipole: the Earth turns once."""
SERIES_POINTS: Final = 2000
"""Most points of each series in a job's result."""
_NONE: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class RomOptions:
    """Options of one attitude simulation: angles in deg, the inertia as 3 or 6 numbers, sensors as `SensorModel`.

    Without ``epoch`` the field is that of 2020-01-01 with Greenwich in the direction of the node's origin at the start.
    Without ``turn_deg`` the body is restored to the orbital axes. ``use_proposed_gains`` takes the gains of
    `propose_gains` for this orbit, body and field instead of ``kp_nm`` and ``kd_nms``.
    """

    altitude_km: float = 500.0
    inclination_deg: float = 62.0
    u0_deg: float = 0.0
    raan_deg: float = 0.0
    epoch: str | None = None
    field: str = "dipole"
    onboard_field: str | None = None
    start_deg: Triple = _NONE
    start_rate: str = "inertial"
    turn_deg: Triple | None = None
    ramp_s: float = 0.0
    kp_nm: float = 0.05
    kd_nms: float = 20.0
    use_proposed_gains: bool = False
    form: str = "corrected"
    guard: bool = False
    feed_forward: bool = False
    inertia_kg_m2: tuple[float, ...] = INERTIA_KG_M2
    torque_limit_nm: float = 0.05
    momentum_limit_nms: float = 5.0
    gravity_gradient: bool = False
    sensor: SensorModel | None = None
    corrected_with: SensorModel | None = None
    eps_arcmin: Triple = _NONE
    mounting_deg: Triple = _NONE
    mu_nt: Triple = _NONE
    common_scale: float = 0.0
    bias_nt: Triple = _NONE
    noise_nt: float = 0.0
    gyro_bias_deg_s: Triple = _NONE
    gyro_noise_deg_s: float = 0.0
    duration_s: float = 10_000.0
    dt_s: float = 0.5
    seed: int = 0

    @classmethod
    def from_dict(cls, spec: Mapping[str, object]) -> RomOptions:
        """Return the options that a job or a command gives.

        Raises
        ------
        OptionError
            Names or values that there are not, all of them in its faults.
        """
        given = {ALIASES.get(name, name): value for name, value in spec.items()}
        known = {f.name for f in fields(cls)}
        faults = [Fault(name, "there is no such option") for name in given if name not in known]
        reader = OptionReader({name: value for name, value in given.items() if name in known}, faults)
        options = cls(**reader.read(cls()))  # type: ignore[arg-type]
        if not faults:
            options._check(faults)
        if faults:
            raise OptionError(f"attitude simulation: {faults[0]}", faults)
        return options

    def to_dict(self) -> dict[str, object]:
        """Return the options as `from_dict` takes them."""
        record = {name: value for name, value in asdict(self).items() if name not in ("sensor", "corrected_with")}
        for name, model in (("sensor", self.sensor), ("corrected_with", self.corrected_with)):
            record[name] = None if model is None else _sensor_record(model)
        return {name: list(value) if isinstance(value, tuple) else value for name, value in record.items()}

    def orbit(self) -> CircularOrbit:
        """Return the orbit."""
        return CircularOrbit(
            altitude_km=self.altitude_km,
            inclination_rad=float(np.deg2rad(self.inclination_deg)),
            u0_rad=float(np.deg2rad(self.u0_deg)),
            raan_rad=float(np.deg2rad(self.raan_deg)),
            epoch_utc=EPOCH_UTC if self.epoch is None else np.datetime64(self.epoch.removesuffix("Z"), "ns"),
            greenwich_rad=0.0 if self.epoch is None else None,
        )

    def body(self) -> Body:
        """Return the body and its wheels."""
        inertia = inertia_matrix(self.inertia_kg_m2)
        return Body(inertia, self.torque_limit_nm, self.momentum_limit_nms, self.gravity_gradient)

    def magnetometer(self) -> Magnetometer:
        """Return the magnetometer with all its errors."""
        e1, e2, e3 = (float(np.deg2rad(angle / 60.0)) for angle in self.eps_arcmin)
        return Magnetometer(
            eps_rad=(e1, e2, e3),
            mounting_rad=_radians(self.mounting_deg),
            model_error_nt=self.mu_nt,
            common_scale=self.common_scale,
            bias_nt=self.bias_nt,
            noise_nt=self.noise_nt,
            sensor=self.sensor,
            corrected_with=self.corrected_with,
        )

    def proposal(self) -> GainProposal:
        """Return the gains that magcal proposes for this orbit, body and field."""
        orbits = 1 if self.field == "dipole" else ORBITS_A_DAY
        return propose_gains(self.orbit(), self.body(), _model(self.field), dt_s=self.dt_s, orbits=orbits)

    def scenario(self) -> RomScenario:
        """Return the scenario, in the units of the core.

        Raises
        ------
        InputError
            A value is out of its range.
        """
        return RomScenario(
            true_field=_model(self.field),
            onboard_field=None if self.onboard_field is None else _model(self.onboard_field),
            orbit=self.orbit(),
            body=self.body(),
            gains=self.proposal().gains if self.use_proposed_gains else Gains(self.kp_nm, self.kd_nms),
            start_rad=_radians(self.start_deg),
            start_rate=self.start_rate,  # type: ignore[arg-type]
            turn=Turn(_radians(self.turn_deg or _NONE), self.ramp_s),
            magnetometer=self.magnetometer(),
            gyro=Gyro(_radians(self.gyro_bias_deg_s), float(np.deg2rad(self.gyro_noise_deg_s))),
            form=self.form,  # type: ignore[arg-type]
            is_guarded=self.guard,
            has_feed_forward=self.feed_forward,
            duration_s=self.duration_s,
            dt_s=self.dt_s,
            seed=self.seed,
        )

    def _check(self, faults: list[Fault]) -> None:
        """Add what the models of the core say against the values."""
        parts = {
            "orbit": self.orbit, "inertia_kg_m2": self.body, "magnetometer": self.magnetometer,
            "scenario": self.scenario,
        }  # fmt: skip
        for where, build in parts.items():
            try:
                build()
            except InputError as error:
                faults.append(Fault(where, error.message))
                return


def attitude_job(spec: Mapping[str, object]) -> dict[str, object]:
    """Return summary, gains, options and thinned series of the attitude simulation that ``spec`` asks for.

    Raises
    ------
    OptionError
        ``spec`` has names or values that there are not.
    ModelRangeError
        The field model does not reach to this orbit or time.
    """
    options = RomOptions.from_dict(spec)
    scenario = options.scenario()
    result = simulate_rom(scenario)
    return {
        **result.to_dict(),
        "gains": {"kp_nm": scenario.gains.kp_nm, "kd_nms": scenario.gains.kd_nms, "tau_s": scenario.gains.tau_s},
        "options": options.to_dict(),
        "series": thinned_series(result),
    }


def thinned_series(result: RomResult) -> dict[str, list[float]]:
    """Return time, error, rate error and the wheels' momentum in columns of at most `SERIES_POINTS`, extremes kept."""
    kept = extreme_indices(result.error_deg, SERIES_POINTS)
    columns = {"t_s": result.t_s, "error_deg": result.error_deg, "rate_error_deg_s": result.rate_error_deg_s}
    columns |= {f"wheel_{axis}_nms": result.wheel_momentum_nms[:, i] for i, axis in enumerate("xyz")}
    return {name: column[kept].tolist() for name, column in columns.items()}


def _model(name: str) -> FieldModel:
    return field_model(name)


def _radians(angles_deg: Triple) -> Triple:
    a, b, c = (float(np.deg2rad(angle)) for angle in angles_deg)
    return (a, b, c)


def _sensor_record(model: SensorModel) -> dict[str, list[float]]:
    return {name: getattr(model, name).tolist() for name in ("bias_nt", "scale", "nonorthogonality_deg")}
