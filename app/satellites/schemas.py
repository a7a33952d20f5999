"""Bodies of the satellites' calls."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, StringConstraints, WithJsonSchema, model_validator
from pydantic_core import PydanticCustomError

from app.http.schemas import Body, Name, Record, Slug, UtcTime
from app.records.calibration_options import CalibrationOptionsBody

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
CatalogId = Annotated[str, StringConstraints(pattern=r"^[A-Z0-9-]{1,16}$")]
NoradId = Annotated[
    CatalogId,
    BeforeValidator(lambda value: str(value) if type(value) is int and value >= 0 else value),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "pattern": "^[A-Z0-9-]{1,16}$"},
                {"type": "integer", "minimum": 0, "maximum": 9_999_999_999_999_999},
            ]
        },
        mode="validation",
    ),
]
ColumnName = Annotated[str, StringConstraints(min_length=1, max_length=200)]


class Policy(CalibrationOptionsBody):
    """What to calibrate by itself when telemetry arrives: the options of a calibration."""

    calibrate: bool = True
    priority: int = Field(0, ge=-100, le=100)


class MagnetometerCreate(Body):
    """A magnetometer: its unit, and how its telemetry is read."""

    id: Slug
    unit: Literal["nT", "uT", "mT", "T", "G", "mG"]
    noise_nt: float | None = Field(None, gt=0, description="Noise of one reading, nT, 1 sigma.")
    columns: dict[Name, ColumnName] | None = Field(None, max_length=100, description="Column of magcal -> yours.")
    axis_map: list[Axis] | None = Field(
        None, min_length=3, max_length=3, description="Which sensor axis the base frame's x, y, z are."
    )
    range_nt: float | None = Field(None, gt=0, description="Readings at or beyond it are saturated, nT.")
    policy: Policy | None = None

    @model_validator(mode="after")
    def _axes_differ(self) -> Self:
        if self.axis_map is not None and len({axis.lstrip("-") for axis in self.axis_map}) != 3:
            raise PydanticCustomError("axis_map", "axis_map names each of x, y, z once")
        return self


class MagnetometerRead(Record):
    """A magnetometer as it is kept."""

    id: str
    satellite: str
    unit: str
    noise_nt: float | None
    columns: dict[str, str] | None
    axis_map: list[str] | None
    range_nt: float | None
    policy: Policy | None
    created_at: UtcTime


class SatelliteCreate(Body):
    """A spacecraft."""

    id: Slug
    name: Name | None = None
    norad_id: NoradId | None = None
    cospar_id: CatalogId | None = None
    retention_days: int | None = Field(
        None, ge=1, le=100_000, description="Raw telemetry older than this may be removed, days; unset: kept for ever."
    )


class SatelliteChange(Body):
    """What may change about a spacecraft; what is left out stays."""

    name: Name | None = None
    retention_days: int | None = Field(None, ge=1, le=100_000)


class MagnetometerChange(Body):
    """What may change about a magnetometer without another meaning of what it has sent; what is left out stays."""

    noise_nt: float | None = Field(None, gt=0)
    policy: Policy | None = None


class SatelliteRead(Record):
    """A spacecraft with its magnetometers."""

    id: str
    name: str | None
    norad_id: str | None
    cospar_id: str | None
    retention_days: int | None
    created_at: UtcTime
    magnetometers: list[MagnetometerRead]
