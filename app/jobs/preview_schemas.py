"""Bodies of the call that shows what a session will be calibrated with."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, JsonValue

from app.http.schemas import Filter, Identifier, OneOf, Record, UtcTime
from app.records.calibration_options import FieldName, IndexGap, Method
from magcal_core.options import (
    BIAS_STEPS,
    LOCKED_TERMS,
    NOISE_MODELS,
    ORBIT_MODELS,
    RESPONSES,
    ROBUST_LOSSES,
    TIME_OFFSETS,
)


class PreviewQuery(Filter):
    """Options of the calibration; with none of them, those that a button without a form would take."""

    method: Method | None = None
    orbit: Annotated[str, OneOf(ORBIT_MODELS)] | None = None
    field: FieldName | None = None
    field_file: Identifier | None = Field(None, description="Coefficients, for a field with `file`.")
    index_gap: IndexGap | None = None
    quiet_only: bool | None = None
    time_offset: Annotated[str, OneOf(TIME_OFFSETS)] | None = None
    regressors: str | None = Field(None, max_length=1000, description="Names, separated by commas, or `auto`.")
    response: Annotated[str, OneOf(RESPONSES)] | None = None
    robust: Annotated[str, OneOf(ROBUST_LOSSES)] | None = None
    noise_model: Annotated[str, OneOf(NOISE_MODELS)] | None = None
    locked_terms: Annotated[str, OneOf(LOCKED_TERMS)] | None = None
    bias_steps: Annotated[str, OneOf(BIAS_STEPS)] | None = Field(None, description="Steps of the bias inside the data.")
    max_orbit_age_days: float | None = Field(None, ge=0, le=36525)

    def asked(self) -> dict[str, object]:
        """Return the options that were given, as the body of a job has them."""
        given: dict[str, object] = self.model_dump(exclude_none=True)
        if self.regressors is not None:
            names = [name.strip() for name in self.regressors.split(",") if name.strip()]
            given["regressors"] = "auto" if names == ["auto"] else names
        return given


class PreviewOrbit(Record):
    """An orbit that gives samples their position, or with none of them the nearest that there is."""

    id: str
    format: str
    name: str | None
    norad_id: str | None
    epoch: UtcTime
    until: UtcTime | None = Field(description="End of an ephemeris.")
    age_days: float = Field(description="Largest distance of its samples from its epoch, days; 0 in an ephemeris.")
    samples: int
    other_object: str | None = Field(description="Which id is not the satellite's, and what both are.")


class PreviewColumn(Record):
    """A column of the telemetry that may be a regressor."""

    name: str
    samples: int = Field(description="Samples in which it has a value.")
    is_constant: bool = Field(description="A column that never changes cannot be told from the bias.")


class LeftOutSamples(Record):
    """Samples that the calibration leaves out; one may have several reasons."""

    reason: str = Field(description="A flag of `magcal_flags`, lower case, or `no_value`: of attitude or a regressor.")
    samples: int


class PreviewProblem(Record):
    """What would make the calibration fail."""

    code: str
    detail: str


class SessionPreview(Record):
    """What a session will be calibrated with."""

    session_id: str
    satellite: str
    magnetometer: str
    options_from: Literal["request", "policy", "set_in_force", "defaults"]
    options: dict[str, JsonValue] = Field(description="Every option, as a job of it would carry them.")
    field_model: str | None = Field(description="As the parameter set will name it; null where it cannot be had.")
    index_needed: str | None = Field(description="Index of the external field that the field model takes.")
    orbit_model: str | None = Field(
        description="`sgp4`, `numerical`, ..., or that the telemetry brings position or reference; null: neither."
    )
    orbits: list[PreviewOrbit]
    regressors: list[PreviewColumn] = Field(description="Columns of the telemetry that may be regressors.")
    samples: int
    usable: int = Field(description="Samples that the fit will have.")
    left_out: list[LeftOutSamples] = Field(description="The most frequent reason first.")
    compared_with: str | None = Field(description="The set in force, which the verdict will be held against.")
    warnings: list[str]
    problems: list[PreviewProblem] = Field(description="None: the job will run, which is not yet a verdict.")
