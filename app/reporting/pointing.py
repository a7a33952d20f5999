"""What a parameter set buys: how well attitude by magnetometer would point with it, from its record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from typing_extensions import TypedDict

from app.records.parameter_set import ParameterSetRecord, ParametersRecord
from magcal_core.errors import InputError
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import SENSOR_NAMES, Parameters

if TYPE_CHECKING:
    from magcal_core.arrays import Floats
    from magcal_core.attitude.circular import CircularOrbit


class PointingRecord(TypedDict):
    """Largest total attitude error, deg, and rate error, deg/s, of the last two of seven orbits."""

    max_error_deg: float
    max_rate_error_deg_s: float


class OrbitPointingRecord(TypedDict):
    """Pointing on one orbit: perfect magnetometer, raw, with this parameter set, with the active one."""

    altitude_km: float
    inclination_deg: float
    ideal: PointingRecord
    raw: PointingRecord
    calibrated: PointingRecord
    active: PointingRecord | None


class ImpactRecord(TypedDict):
    """Pointing on every orbit that was tried, and what it holds for."""

    orbits: list[OrbitPointingRecord]
    field_model: str
    kp_nm: float
    kd_nms: float
    duration_s: float


def circle(altitude_km: float, inclination_deg: float) -> CircularOrbit:
    """Return a circular orbit with Greenwich at its node at the start.

    Raises
    ------
    InputError
        Altitude or inclination is out of its range.
    """
    from magcal_core.attitude.circular import CircularOrbit

    return CircularOrbit(altitude_km, float(np.deg2rad(inclination_deg)), greenwich_rad=0.0)


def pointing_of(
    record: ParameterSetRecord, active: ParametersRecord | None = None, orbits: Sequence[CircularOrbit] = ()
) -> ImpactRecord:
    """Return the pointing raw, with ``record`` and with ``active``; the real sensor is drawn from the covariance.

    Without ``orbits`` those at 500 km, inclined by 62 and by 97.7 deg.

    Raises
    ------
    InputError
        The parameter set lacks a parameter or a covariance, so that nothing can be said of the real sensor.
    """
    from magcal_core.attitude.experiment import ORBITS, calibration_impact

    found = calibration_impact(
        _sensor(record["parameters"]),
        _covariance(record),
        active=None if active is None else _sensor(active),
        orbits=tuple(orbits) or ORBITS,
    )
    return cast("ImpactRecord", found.to_dict())


def _sensor(parameters: ParametersRecord) -> SensorModel:
    groups = (parameters["bias_nt"], parameters["scale"], parameters["nonorthogonality_deg"])
    if any(value is None for group in groups for value in group):
        raise InputError("the parameter set lacks a parameter, so its pointing is unknown")
    return Parameters.from_record({"parameters": parameters}).sensor


def _covariance(record: ParameterSetRecord) -> Floats:
    """Return the covariance of the nine parameters of the sensor, shape (9, 9), in their order."""
    names = record["parameter_names"]
    missing = [name for name in SENSOR_NAMES if name not in names]
    if missing:
        raise InputError(f"the covariance has no {', '.join(missing)}, so the pointing is unknown")
    chosen = [names.index(name) for name in SENSOR_NAMES]
    covariance = np.array(record["covariance"], np.float64)
    return covariance[np.ix_(chosen, chosen)]
