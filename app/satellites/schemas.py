"""Bodies of the satellites' calls."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, StringConstraints, WithJsonSchema, model_validator
from pydantic_core import PydanticCustomError

from app.http.schemas import Body, Name, PageQuery, Record, Search, Slug, UtcTime
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


Unit = Literal["nT", "uT", "mT", "T", "G", "mG", "counts"]
Columns = Annotated[dict[Name, ColumnName], Field(max_length=100)]


class ReadingBody(Body):
    """How telemetry is written; what is not said is as `docs/telemetry.md` has it."""

    columns: Columns | None = Field(None, description="Column of magcal -> yours.")
    axis_map: list[Axis] | None = Field(
        None, min_length=3, max_length=3, description="Which sensor axis the base frame's x, y, z are."
    )
    range_nt: float | None = Field(None, gt=0, description="Readings at or beyond it are saturated, nT.")
    nt_per_count: float | None = Field(None, gt=0, lt=1e9, description="nT in one count, where the unit is counts.")
    time_format: Annotated[str, StringConstraints(max_length=100)] | None = Field(
        None, description="Form of the times where it is neither ISO 8601 with a zone nor seconds since 1970."
    )
    time_epoch: UtcTime | None = Field(None, description="Instant that seconds since boot count from; the year of doy.")
    fill_values: list[float] | None = Field(
        None, max_length=20, description="Numbers that stand for a missing reading, in the sensor's unit."
    )
    validity_column: ColumnName | None = Field(None, description="Column that says which readings are good.")
    valid_values: list[str | float] | None = Field(
        None, max_length=20, description="Its values that do; unset: all but 0, false, invalid and the like."
    )

    @model_validator(mode="after")
    def _axes_differ(self) -> Self:
        if self.axis_map is not None and len({axis.lstrip("-") for axis in self.axis_map}) != 3:
            raise PydanticCustomError("axis_map", "axis_map names each of x, y, z once")
        return self


class MagnetometerCreate(ReadingBody):
    """A magnetometer: its unit, and how its telemetry is read."""

    id: Slug
    unit: Unit
    noise_nt: float | None = Field(None, gt=0, description="Noise of one reading, nT, 1 sigma.")
    integration_s: float | None = Field(
        None,
        ge=0,
        le=60,
        description="Time about its stamp over which the sensor averages a reading, s; unset or 0: it does not.",
    )
    policy: Policy | None = None


class MagnetometerQuery(PageQuery):
    """Which magnetometers of a satellite to list."""

    q: Search | None = Field(None, description="Part of an id.")
    sort: Literal["id", "-id", "created", "-created"] = Field("id", description="`-created`: the newest first.")


class MagnetometerShort(Record):
    """A magnetometer in under 500 bytes."""

    id: str
    satellite: str
    unit: str
    noise_nt: float | None
    integration_s: float | None
    range_nt: float | None
    created_at: UtcTime


class MagnetometerRead(MagnetometerShort):
    """A magnetometer as it is kept."""

    columns: dict[str, str] | None
    axis_map: list[str] | None
    nt_per_count: float | None
    time_format: str | None
    time_epoch: str | None
    fill_values: list[float] | None
    validity_column: str | None
    valid_values: list[str | float] | None
    policy: Policy | None


class SatelliteLimits(Body):
    """From which age on a satellite's things need attention; what is not given is magcal's own."""

    data_stale_days: float | None = Field(
        None, gt=0, le=100_000, description="The newest reading may be so old, days; unset: 30."
    )
    orbit_stale_days: float | None = Field(
        None, gt=0, le=100_000, description="The newest orbit may be so old, days; unset: 7."
    )
    station_silent_hours: float | None = Field(
        None, gt=0, le=2_400_000, description="Nothing may have arrived for so long, h; unset: 72."
    )


class SatelliteCreate(SatelliteLimits):
    """A spacecraft."""

    id: Slug
    name: Name | None = None
    norad_id: NoradId | None = None
    cospar_id: CatalogId | None = None
    retention_days: int | None = Field(
        None, ge=1, le=100_000, description="Raw telemetry older than this may be removed, days; unset: kept for ever."
    )


class SatelliteChange(SatelliteLimits):
    """What may change about a spacecraft; what is left out stays."""

    name: Name | None = None
    norad_id: NoradId | None = None
    retention_days: int | None = Field(None, ge=1, le=100_000)


class SatelliteQuery(PageQuery):
    """Which satellites to list."""

    q: Search | None = Field(None, description="Part of an id, name or catalogue number.")
    sort: Literal["created", "-created", "id", "-id"] = Field("-created", description="`-created`: the newest first.")


class MagnetometerChange(ReadingBody):
    """What may change about a magnetometer; what is left out stays, and so does how its sessions were read."""

    unit: Unit | None = None
    noise_nt: float | None = Field(None, gt=0)
    integration_s: float | None = Field(None, ge=0, le=60)
    policy: Policy | None = None


class SatelliteShort(Record):
    """A spacecraft without its magnetometers, in under 500 bytes."""

    id: str
    name: str | None
    norad_id: str | None
    cospar_id: str | None
    retention_days: int | None
    data_stale_days: float | None
    orbit_stale_days: float | None
    station_silent_hours: float | None
    created_at: UtcTime


class SatelliteRead(SatelliteShort):
    """A spacecraft with its magnetometers."""

    magnetometers: list[MagnetometerRead]
