"""Bodies of a look at telemetry before it is sent."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, Json, JsonValue, StringConstraints, WithJsonSchema

from app.http.schemas import Filter, Record, Slug, UtcTime
from app.satellites.schemas import Columns, Unit
from app.sessions.sensor_reading import SensorReading

MOST_TEXT: Final = 30_000
"""Characters of a map of columns in a URL: a hundred names of each side, and as much again."""


def _bounded(value: object) -> object:
    if isinstance(value, str) and len(value) > MOST_TEXT:
        raise ValueError(f"longer than {MOST_TEXT} characters")
    return value


_TEXT: Final = {"type": "string", "contentMediaType": "application/json", "maxLength": MOST_TEXT}
ColumnsText = Annotated[Json[Columns], BeforeValidator(_bounded), WithJsonSchema(_TEXT)]


class LookQuery(Filter):
    """Whose telemetry it is, and how to read it instead of as the magnetometer is kept; what is left out stays."""

    magnetometer: Slug
    columns: ColumnsText | None = Field(None, description="Column of magcal -> that of the table, a JSON object.")
    unit: Unit | None = None
    nt_per_count: float | None = Field(None, gt=0, lt=1e9, description="nT in one count, where the unit is counts.")
    time_format: Annotated[str, StringConstraints(max_length=100)] | None = Field(
        None, description="Form of the times; `iso`: ISO 8601 with a zone, or seconds since 1970."
    )
    time_epoch: UtcTime | None = Field(None, description="Instant that seconds since boot count from; the year of doy.")

    def reading(self, kept: SensorReading) -> SensorReading:
        """Return ``kept`` with what the query says."""
        said = self.model_dump(exclude_unset=True, exclude={"magnetometer", "time_epoch"})
        if "unit" in said:
            said.setdefault("nt_per_count", None)
        if "time_format" in said:
            said["time_epoch"] = None
        if self.time_epoch is not None:
            said["time_epoch"] = self.time_epoch.isoformat()
        return replace(kept, **said)


class ColumnLook(Record):
    """One column of a table."""

    name: str
    taken_for: str | None = Field(description="Its name in magcal; null: kept as housekeeping under its own.")
    may_be: str | None = Field(description="What it may be, where a needed column is missing.")


class RowLook(Record):
    """One row of a table."""

    cells: list[str] = Field(description="Its cells as they stand there, in the order of the columns.")


class SampleLook(Record):
    """What would be kept."""

    samples: int
    used: int = Field(description="Samples without a flag.")
    data_from: str
    data_until: str
    b_median_nt: float | None = Field(description="Median of |B| as measured, nT.")
    housekeeping: list[str]
    first_times: list[str] = Field(description="Times of the first samples, UTC.")
    first_nt: list[list[float | None]] = Field(description="Their readings in the base frame, nT.")


class TelemetryLook(Record):
    """How telemetry would be read. Nothing of it was kept."""

    format: str | None = Field(description="Format of the table; null where it has none that is known.")
    columns: list[ColumnLook]
    rows: list[RowLook] = Field(description="The first five rows.")
    reading: dict[str, JsonValue] = Field(description="How it was read: as the magnetometer is kept, and the query.")
    missing: list[str] = Field(description="Needed columns that the table has not.")
    suggested_columns: dict[str, str] = Field(description="Column of magcal -> that of the table that may be meant.")
    suggested_unit: str | None = Field(description="Unit that the readings suit better.")
    suggested_time_formats: list[str] = Field(description="Forms in which its first time is one, the likeliest first.")
    time_formats: dict[str, str] = Field(description="Forms of time that may be declared, and what each is.")
    read: SampleLook | None = Field(description="What would be kept; null where it would be refused.")
    problem: dict[str, JsonValue] | None = Field(description="Why it would be refused.")
