"""What a calibration buys: how well ROM would point with the raw sensor, with this calibration and with another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.circular import CircularOrbit
from magcal_core.attitude.rom import FieldAlongOrbit, simulate_rom
from magcal_core.attitude.scenario import Gains, RomScenario
from magcal_core.attitude.sensing import Magnetometer
from magcal_core.errors import InputError
from magcal_core.field import FieldModel
from magcal_core.field.models import field_model
from magcal_core.sensor.model import SensorModel

ORBITS: Final = tuple(
    CircularOrbit(altitude_km=500.0, inclination_rad=float(np.deg2rad(inclination_deg)), greenwich_rad=0.0)
    for inclination_deg in (62.0, 97.7)
)
"""Orbits of `pointing_impact` where none are given: 500 km, inclined by 62 deg, and sun-synchronous."""
START_RAD: Final = (float(np.deg2rad(10.0)),) * 3
DURATION_S: Final = 40_000.0
"""Seven orbits; the error is the largest of the last two, when the start is forgotten."""
DT_S: Final = 2.0
DRAWS: Final = 16
"""Sensors that `calibration_impact` draws from the covariance."""


@dataclass(frozen=True, slots=True, eq=False)
class _Sensors:
    """How the magnetometer may really be: the likeliest, for the raw readings, and all that are to be tried."""

    likeliest: SensorModel
    tried: Sequence[SensorModel]


@dataclass(frozen=True, slots=True)
class Pointing:
    """Largest total attitude error, deg, and rate error, deg/s, in the last two orbits."""

    max_error_deg: float
    max_rate_error_deg_s: float

    def to_dict(self) -> dict[str, float]:
        """Return the figures under their names."""
        return {"max_error_deg": self.max_error_deg, "max_rate_error_deg_s": self.max_rate_error_deg_s}


@dataclass(frozen=True, slots=True)
class OrbitImpact:
    """Pointing on one orbit; ``ideal`` is a perfect magnetometer's, ``active`` None where there is no other set."""

    altitude_km: float
    inclination_deg: float
    ideal: Pointing
    raw: Pointing
    calibrated: Pointing
    active: Pointing | None

    def to_dict(self) -> dict[str, object]:
        """Return the orbit and its figures."""
        return {
            "altitude_km": self.altitude_km,
            "inclination_deg": self.inclination_deg,
            "ideal": self.ideal.to_dict(),
            "raw": self.raw.to_dict(),
            "calibrated": self.calibrated.to_dict(),
            "active": None if self.active is None else self.active.to_dict(),
        }


@dataclass(frozen=True, slots=True)
class PointingImpact:
    """Pointing with the raw sensor, this calibration and the active one, orbit by orbit, and what it holds for."""

    orbits: tuple[OrbitImpact, ...]
    field_model: str
    gains: Gains
    duration_s: float

    def to_dict(self) -> dict[str, object]:
        """Return the figures as a record."""
        return {
            "orbits": [orbit.to_dict() for orbit in self.orbits],
            "field_model": self.field_model,
            "kp_nm": self.gains.kp_nm,
            "kd_nms": self.gains.kd_nms,
            "duration_s": self.duration_s,
        }


def pointing_impact(
    sensor: SensorModel,
    corrected_with: SensorModel,
    *,
    active: SensorModel | None = None,
    orbits: Sequence[CircularOrbit] = ORBITS,
    field: FieldModel | None = None,
    gains: Gains | None = None,
    duration_s: float = DURATION_S,
) -> PointingImpact:
    """Return how ROM points with ``sensor`` raw, corrected with ``corrected_with`` and corrected with ``active``.

    ``sensor`` is how the magnetometer really is. IGRF, kp 0.05 Nm and kd 20 Nms where nothing else is given; the start
    is (10, 10, 10) deg at the orbital rate about the body axes, which leaves 0.17 deg even to a perfect sensor.

    Raises
    ------
    ModelRangeError
        The field model does not reach to an orbit.

    Notes
    -----
    `docs/references.md`: ROM; the figures for DEKART are in `docs/attitude.md`.
    """
    return _impact(_Sensors(sensor, [sensor]), corrected_with, active, _studies(orbits, field, gains, duration_s))


def calibration_impact(
    calibrated: SensorModel,
    covariance: Floats,
    *,
    active: SensorModel | None = None,
    orbits: Sequence[CircularOrbit] = ORBITS,
    field: FieldModel | None = None,
    gains: Gains | None = None,
    duration_s: float = DURATION_S,
    draws: int = DRAWS,
    seed: int = 0,
) -> PointingImpact:
    """Return how ROM points after a calibration that is only as good as its covariance says: the worst of ``draws``.

    Parameters
    ----------
    calibrated : SensorModel
        The parameters of the calibration: the reading is corrected with them.
    covariance : shape (m, m), m >= 9
        Of bias_nt, scale, nonorthogonality_deg, in this order, and whatever follows: the real sensor is drawn from it.

    Raises
    ------
    InputError
        The covariance is not that of nine parameters or more, or ``draws`` is not positive.
    OptionError
        The covariance is so large that a sensor drawn from it is none.
    ModelRangeError
        The field model does not reach to an orbit.
    """
    if covariance.ndim != 2 or min(covariance.shape) < 9 or not np.all(np.isfinite(covariance)) or draws < 1:
        raise InputError(
            f"want a finite covariance of at least 9 x 9 and a draw or more, not {covariance.shape}, {draws}"
        )
    mean = np.concatenate([calibrated.bias_nt, calibrated.scale, calibrated.nonorthogonality_deg])
    values, vectors = np.linalg.eigh(covariance[:9, :9])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = mean + np.random.default_rng(seed).normal(size=(draws, 9)) @ root.T
    sensors = [SensorModel(p[0:3], p[3:6], p[6:9]) for p in drawn]
    return _impact(_Sensors(calibrated, sensors), calibrated, active, _studies(orbits, field, gains, duration_s))


def _studies(
    orbits: Sequence[CircularOrbit], field: FieldModel | None, gains: Gains | None, duration_s: float
) -> list[RomScenario]:
    """Return a scenario for each orbit, with a perfect sensor."""
    true_field = field_model("igrf") if field is None else field
    return [
        RomScenario(
            true_field=true_field,
            orbit=orbit,
            gains=Gains() if gains is None else gains,
            start_rad=START_RAD,
            start_rate="body",
            duration_s=duration_s,
            dt_s=DT_S,
        )
        for orbit in orbits
    ]


def _impact(
    sensors: _Sensors,
    corrected_with: SensorModel,
    active: SensorModel | None,
    studies: Sequence[RomScenario],
) -> PointingImpact:
    """Return the worst pointing over ``sensors`` for each way of correcting them."""
    rows = []
    for study in studies:
        along = FieldAlongOrbit.of(study)
        rows.append(
            OrbitImpact(
                altitude_km=study.orbit.altitude_km,
                inclination_deg=float(np.rad2deg(study.orbit.inclination_rad)),
                ideal=_pointing(study, along, Magnetometer()),
                raw=_pointing(study, along, Magnetometer(sensor=sensors.likeliest)),
                calibrated=_worst(study, along, sensors.tried, corrected_with),
                active=None if active is None else _worst(study, along, sensors.tried, active),
            )
        )
    first = studies[0]
    return PointingImpact(tuple(rows), first.true_field.name, first.gains, first.duration_s)


def _worst(
    study: RomScenario, along: FieldAlongOrbit, sensors: Sequence[SensorModel], corrected_with: SensorModel
) -> Pointing:
    """Return the largest error and the largest rate error over ``sensors``."""
    each = [_pointing(study, along, Magnetometer(sensor=s, corrected_with=corrected_with)) for s in sensors]
    return Pointing(max(p.max_error_deg for p in each), max(p.max_rate_error_deg_s for p in each))


def _pointing(study: RomScenario, along: FieldAlongOrbit, magnetometer: Magnetometer) -> Pointing:
    """Return the steady pointing with one magnetometer."""
    result = simulate_rom(replace(study, magnetometer=magnetometer), along)
    last = result.in_last_two_orbits
    return Pointing(float(result.error_deg[last].max()), float(result.rate_error_deg_s[last].max()))
