"""The options of a calibration as requests carry them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from app.http.schemas import Body, OneOf
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.field.choices import INDEX_GAPS
from magcal_core.field.models import FIELD_MODELS
from magcal_core.options import (
    BIAS_STEPS,
    GYRO_UNITS,
    LOCKED_TERMS,
    NOISE_MODELS,
    ORBIT_MODELS,
    RESPONSES,
    ROBUST_LOSSES,
    TIME_OFFSETS,
    CalibrationOptions,
)
from magcal_core.telemetry.spans import MOST_SPANS
from magcal_core.units import TIME_SCALES

Method = Annotated[str, OneOf(ESTIMATORS)]
FieldName = Annotated[
    str, Field(max_length=64, examples=list(FIELD_MODELS), description="A field model, or parts of one joined by +.")
]
SpanText = Annotated[
    str,
    Field(
        max_length=100,
        examples=["2026-11-29T03:30:00Z/2026-11-29T03:50:00Z"],
        description="FROM/UNTIL, two times in ISO 8601 with Z; what is at UNTIL stays.",
    ),
]
IndexGap = Annotated[str, OneOf(INDEX_GAPS)]


class GyroBody(Body):
    """The session's columns of angular rate, one an axis, and their unit."""

    columns: list[str] = Field(min_length=3, max_length=3)
    unit: Annotated[str, OneOf(GYRO_UNITS)] = "deg/s"


class CalibrationOptionsBody(Body):
    """Options of a calibration; what is left out has the default of `magcal calibrate`."""

    method: Method | None = None
    orbit: Annotated[str, OneOf(ORBIT_MODELS)] | None = None
    field: FieldName | None = None
    field_max_degree: int | None = Field(None, ge=1, le=250)
    index_gap: IndexGap | None = Field(None, description="Where the index of the field has no value.")
    quiet_only: bool | None = Field(None, description="Only samples of quiet hours; needs the index Kp.")
    time_offset: Annotated[str, OneOf(TIME_OFFSETS)] | None = None
    time_drift: bool | None = None
    regressors: list[str] | Literal["auto"] | None = None
    response: Annotated[str, OneOf(RESPONSES)] | None = None
    robust: Annotated[str, OneOf(ROBUST_LOSSES)] | None = None
    noise_model: Annotated[str, OneOf(NOISE_MODELS)] | None = None
    noise_nt: float | None = Field(
        None, gt=0, description="Noise of one reading, nT, 1 sigma; unset: the magnetometer's."
    )
    integration_s: float | None = Field(
        None, ge=0, le=60, description="Time over which a reading is averaged, s; unset: the magnetometer's."
    )
    bias_steps: Annotated[str, OneOf(BIAS_STEPS)] | None = Field(
        None, description="Steps of the bias inside the data: named, fitted, or not looked for."
    )
    windows: Annotated[float, Field(ge=0.1, le=8784)] | Literal["auto"] | None = Field(
        None, description="Hours of windows that are calibrated one by one as well, with their trend."
    )
    locked_terms: Annotated[str, OneOf(LOCKED_TERMS)] | None = None
    without: list[SpanText] | None = Field(
        None, max_length=MOST_SPANS, description="Spans of time to leave out, as if they had not been sent."
    )
    time_scale: Annotated[str, OneOf(TIME_SCALES)] | None = Field(
        None,
        description="Scale that the clock of the telemetry keeps where its times were read as UTC and are not: they "
        "are moved back to UTC first. For telemetry to come, declare the magnetometer's `time_format`.",
    )
    gyro: GyroBody | None = None
    max_orbit_age_days: float | None = Field(None, ge=0, le=36525)
    bootstrap: int | None = Field(None, ge=0, le=10_000)
    seed: int | None = Field(None, ge=0)

    @property
    def options(self) -> dict[str, object]:
        """The options that were given, under their names."""
        names = set(CalibrationOptionsBody.model_fields) - {"gyro"}
        given = {name: value for name, value in self.model_dump(include=names).items() if value is not None}
        return given if self.gyro is None else {**given, "gyro": self.gyro.columns, "gyro_unit": self.gyro.unit}


def as_asked(options: CalibrationOptions) -> dict[str, object]:
    """Return every option as a request carries it, so that what a job was asked for can be asked for again."""
    values = options.to_dict()
    unit = values.pop("gyro_unit")
    return values | {"gyro": {"columns": list(options.gyro), "unit": unit} if options.gyro else None}


def as_options(asked: Mapping[str, object]) -> dict[str, object]:
    """Return the options of a job's request as `CalibrationOptions.from_dict` takes them.

    A request that an earlier release has queued names the columns of its gyro, and their unit, beside each other.
    """
    gyro = asked.get("gyro")
    if isinstance(gyro, dict):
        return {**asked, "gyro": gyro["columns"], "gyro_unit": gyro["unit"]}
    return {name: value for name, value in asked.items() if (name, value) != ("gyro", None)}
