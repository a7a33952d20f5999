"""Bodies of the parameter sets' calls."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.http.schemas import Body, Filter, Identifier, Name, OneOf, PageQuery, Record, Search, Slug, UtcTime
from app.http.tables import TableFormat
from app.parameter_sets.export_formats import EXPORTERS

Status = Literal["candidate", "active", "retired"]


class VerdictRead(Record):
    """What magcal says of a parameter set."""

    grade: Literal["accept", "weak", "refuse"]
    reasons: list[str]
    grades: list[Literal["accept", "weak", "refuse"]] = Field(
        default_factory=list, description="What each reason alone makes of it; none in sets from before it was kept."
    )


class CureRead(Record):
    """A button: the call that it makes, or with GET the page that it goes to."""

    label: str
    method: Literal["GET", "POST"]
    path: str
    body: dict[str, JsonValue] | None


class ReasonRead(Record):
    """One reason of a verdict in plain words, and what may mend it."""

    code: str
    grade: Literal["accept", "weak", "refuse"] | None = Field(
        description="Which limit it passed; null in sets from before it was kept."
    )
    sentence: str
    figure: str = Field(description="The figure and its limit.")
    advice: str
    page: str = Field(description="Page of the service that says more of it.")
    cure: CureRead | None


class ReasonList(Record):
    """The reasons of a verdict, the gravest first."""

    items: list[ReasonRead]


class ParametersRead(Record):
    """Parameters of the sensor model, or their standard errors."""

    bias_nt: list[float | None]
    scale: list[float | None]
    nonorthogonality_deg: list[float | None]
    time_offset_s: float | None
    regressors: dict[str, list[float | None]]
    time_base_utc: str | None = Field(
        None,
        description="Since when the regressor `time` counts its hours; only where there is one.",
        exclude_if=lambda value: value is None,
    )


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


class ParameterSetSummary(Record):
    """A parameter set in under 500 bytes, for lists."""

    id: str
    satellite: str
    magnetometer: str
    status: Status
    grade: Literal["accept", "weak", "refuse"]
    method: str
    data_from: UtcTime
    data_until: UtcTime
    created_at: UtcTime
    rms_nt: float | None = Field(description="Residual RMS of the fit, nT.")


SetSort = Literal["created", "-created", "data_from", "-data_from"]
SET_SORTS: Final = "`-created`: the newest first; `data_from` is the first instant of the data."


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
    q: Search | None = Field(None, description="Part of an id of the set, its satellite or magnetometer.")
    sort: SetSort = Field("-created", description=SET_SORTS)


class TableQuery(Filter):
    """How a table is written."""

    format: TableFormat | None = Field(None, description="Instead of Accept.")


class ExportQuery(Filter):
    """In which convention and format a parameter set is written for flight software."""

    convention: str = Field("exact", max_length=32)
    format: Annotated[str, OneOf(EXPORTERS)] = "json"
    first_id: int = Field(0, ge=0, le=0xFFFF_FF00, description="`fprime-dat`: the id of MGM_OFFSET; the others follow.")
    crc: bool = Field(
        True, description="`fprime-dat`: with the CRC of the records before them; older F Primes have none."
    )


class ApplyQuery(TableQuery):
    """How telemetry is corrected."""

    inverse: bool = Field(False, description="Un-apply: from corrected back to raw readings.")


class ActivateBody(Body):
    """How a parameter set is put in force."""

    force: bool = Field(False, description="Also where the verdict is `refuse`.")
    reason: Name | None = Field(
        None, description="Why; required where the verdict is `refuse`. The audit trail has it."
    )
