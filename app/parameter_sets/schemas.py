"""Bodies of the parameter sets' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field, JsonValue

from app.http.schemas import Body, Filter, Identifier, Name, PageQuery, Record, Slug, UtcTime

Status = Literal["candidate", "active", "retired"]
TableFormat = Literal["csv", "ndjson", "json", "parquet"]


class VerdictRead(Record):
    """What magcal says of a parameter set."""

    grade: Literal["accept", "weak", "refuse"]
    reasons: list[str]


class ParametersRead(Record):
    """Parameters of the sensor model, or their standard errors."""

    bias_nt: list[float | None]
    scale: list[float | None]
    nonorthogonality_deg: list[float | None]
    time_offset_s: float | None
    regressors: dict[str, list[float | None]]


class ParameterSetRead(Record):
    """A parameter set; some methods add results of their own."""

    model_config = ConfigDict(extra="allow")

    id: str
    satellite: str
    magnetometer: str
    session_ids: list[str]
    job_id: str
    status: Status
    verdict: VerdictRead
    created_at: UtcTime
    data_from: UtcTime
    data_until: UtcTime
    method: str
    field_model: str
    orbit_model: str
    parameters: ParametersRead
    standard_errors: ParametersRead
    parameter_names: list[str]
    covariance: list[list[float | None]]
    formal_standard_errors: ParametersRead
    matrix: list[list[float]]
    correction_matrix: list[list[float]]
    candidates: list[dict[str, JsonValue]]
    statistics: dict[str, JsonValue]
    observability: dict[str, JsonValue]
    warnings: list[str]
    provenance: dict[str, JsonValue]


class ParameterSetQuery(PageQuery):
    """Which parameter sets to list."""

    satellite: Slug | None = None
    magnetometer: Slug | None = None
    session: Identifier | None = None
    job: Identifier | None = None
    status: Status | None = None
    method: str | None = Field(None, max_length=32)
    grade: Literal["accept", "weak", "refuse"] | None = None
    since: UtcTime | None = Field(None, description="Made from data that reach to this time or beyond.")
    until: UtcTime | None = Field(None, description="Made from data that begin at this time or before.")
    at: UtcTime | None = Field(None, description="In force at this time.")


class TableQuery(Filter):
    """How a table is written."""

    format: TableFormat | None = Field(None, description="Instead of Accept.")


class ExportQuery(Filter):
    """In which convention and format a parameter set is written for flight software."""

    convention: str = Field("exact", max_length=32)
    format: Literal["json", "csv", "yaml", "c"] = "json"


class ApplyQuery(TableQuery):
    """How telemetry is corrected."""

    inverse: bool = Field(False, description="Un-apply: from corrected back to raw readings.")


class ActivateBody(Body):
    """How a parameter set is put in force."""

    force: bool = Field(False, description="Also where the verdict is `refuse`.")
    reason: Name | None = None
