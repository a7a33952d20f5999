"""Values of the attitude simulation's options: from what JSON can say to what the core takes, every fault kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, TypeAlias

from magcal_core.errors import Fault, InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from magcal_core.sensor.model import SensorModel

Triple: TypeAlias = tuple[float, float, float]
Value: TypeAlias = "float | int | bool | str | tuple[float, ...] | SensorModel | None"

CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "form": ("corrected", "printed"),
    "start_rate": ("inertial", "orbital", "body"),
}
"""Options that take one of a few words."""
RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "altitude_km": (100.0, 100_000.0),
    "inclination_deg": (0.0, 180.0),
    "u0_deg": (-360.0, 360.0),
    "raan_deg": (-360.0, 360.0),
    "ramp_s": (0.0, 1e7),
    "kp_nm": (1e-9, 1e6),
    "kd_nms": (1e-9, 1e9),
    "torque_limit_nm": (1e-9, 1e6),
    "momentum_limit_nms": (1e-9, 1e9),
    "common_scale": (-0.99, 100.0),
    "noise_nt": (0.0, 1e6),
    "gyro_noise_deg_s": (0.0, 100.0),
    "duration_s": (1.0, 1e7),
    "dt_s": (1e-3, 100.0),
    "seed": (0.0, 2.0**53),
}
"""Least and greatest value of each option that is one number."""
_OPTIONAL: Final = ("epoch", "onboard_field", "turn_deg", "sensor", "corrected_with")
_SENSOR: Final = ("sensor", "corrected_with")


@dataclass(frozen=True, slots=True)
class OptionReader:
    """Reads the given options by their names; what is wrong goes to ``faults``, and the default stands in for it."""

    given: Mapping[str, object]
    faults: list[Fault]

    def read(self, defaults: DataclassInstance) -> dict[str, Value]:
        """Return a value for every option that is given."""
        values: dict[str, Value] = {}
        for name in (f.name for f in fields(defaults) if f.name in self.given):
            try:
                values[name] = _value(name, self.given[name], getattr(defaults, name))
            except InputError as error:
                self.faults.append(Fault(name, error.message))
                self.faults.extend(Fault(f"{name}.{fault.where}", fault.why) for fault in error.faults)
        return values


def sensor_model(record: object) -> SensorModel:
    """Return the sensor of a parameter set, or of its ``parameters`` alone.

    Raises
    ------
    InputError
        These are not the parameters of a magnetometer.
    """
    import numpy as np

    from magcal_core.sensor.model import SensorModel

    if isinstance(record, SensorModel):
        return record
    inner = record.get("parameters", record) if isinstance(record, Mapping) else record
    if not isinstance(inner, Mapping):
        raise InputError("want a parameter set: an object with bias_nt, scale and nonorthogonality_deg")
    names = ("bias_nt", "scale", "nonorthogonality_deg")
    missing = [name for name in names if name not in inner]
    if missing:
        raise InputError(f"the parameter set has no {', '.join(missing)}")
    bias_nt, scale, angles_deg = (np.array(_numbers(inner[name], (3,))) for name in names)
    return SensorModel(bias_nt, scale, angles_deg)


def _value(name: str, given: object, default: Value) -> Value:
    """Return one option's value; its kind follows from its name and its default."""
    if given is None and name in _OPTIONAL:
        return None
    if name in _SENSOR:
        return sensor_model(given)
    if name in RANGES:
        return _number(given, RANGES[name], is_whole=isinstance(default, int))
    if isinstance(default, tuple) or name == "turn_deg":
        return _numbers(given, (3, 6) if name == "inertia_kg_m2" else (3,))
    return _flag(given) if isinstance(default, bool) else _word(name, given)


def _flag(given: object) -> bool:
    if not isinstance(given, bool):
        raise InputError("want true or false")
    return given


def _word(name: str, given: object) -> str:
    if name == "epoch":
        return _epoch(given)
    if name in CHOICES and given not in CHOICES[name]:
        raise InputError(f"want one of {', '.join(CHOICES[name])}")
    if not isinstance(given, str):
        raise InputError("want a name")
    return given


def _number(given: object, limits: tuple[float, float], *, is_whole: bool) -> float | int:
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not math.isfinite(given):
        raise InputError("want a finite number")
    if not limits[0] <= given <= limits[1]:
        raise InputError(f"is {given:g}; want {limits[0]:g} to {limits[1]:g}")
    if is_whole and given != int(given):
        raise InputError("want a whole number")
    return int(given) if is_whole else float(given)


def _numbers(given: object, lengths: tuple[int, ...]) -> tuple[float, ...]:
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) not in lengths:
        raise InputError(f"want {' or '.join(map(str, lengths))} numbers")
    return tuple(float(_number(each, (-1e9, 1e9), is_whole=False)) for each in given)


def _epoch(given: object) -> str:
    """Return a UTC time in ISO 8601 with ``Z`` from one with any zone."""
    wanted = "want a time in ISO 8601 with a zone, such as 2020-01-01T00:00:00Z"
    if not isinstance(given, str):
        raise InputError(wanted)
    try:
        time = datetime.fromisoformat(given)
    except ValueError:
        raise InputError(wanted) from None
    if time.tzinfo is None:
        raise InputError(wanted)
    return time.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
