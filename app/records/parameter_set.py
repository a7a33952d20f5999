"""The records of the service as programs read them from JSON: a parameter set and its parts, checked on reading."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Final

from pydantic import ConfigDict, TypeAdapter, ValidationError, with_config
from typing_extensions import TypedDict

from magcal_core.errors import Fault, InputError

_LOOSE: Final = ConfigDict(extra="allow")


class ParametersRecord(TypedDict):
    """Parameters of the sensor model, or errors of them."""

    bias_nt: list[float | None]
    scale: list[float | None]
    nonorthogonality_deg: list[float | None]
    time_offset_s: float | None
    regressors: dict[str, list[float | None]]


class VerdictRecord(TypedDict):
    """The verdict in one word, with its reasons as ``code: text``."""

    grade: str
    reasons: list[str]


class ResidualStatisticsRecord(TypedDict):
    """Statistics of a residual, nT."""

    mean_nt: float | None
    std_nt: float | None
    rms_nt: float | None
    max_abs_nt: float | None
    max_percent: float | None


@with_config(_LOOSE)
class StatisticsRecord(TypedDict):
    """What the calibration used and what it left."""

    samples: int
    rejected: int
    cross_validated_rms_nt: float | None
    before: ResidualStatisticsRecord
    after: ResidualStatisticsRecord


@with_config(_LOOSE)
class ObservabilityRecord(TypedDict):
    """How well the samples determine the parameters."""

    index: float | None
    condition_number: float | None
    sphere_coverage: float | None
    weak_directions: list[str]


@with_config(_LOOSE)
class ProvenanceRecord(TypedDict, total=False):
    """Where a parameter set comes from."""

    software: str | dict[str, str]
    inputs: list[dict[str, object]]
    orbits: list[dict[str, object]]
    options: dict[str, object]


class ParameterSetIds(TypedDict, total=False):
    """What only the service knows of a parameter set."""

    id: str
    satellite: str
    magnetometer: str
    session_ids: list[str]
    job_id: str | None
    created_at: str


@with_config(_LOOSE)
class ParameterSetRecord(ParameterSetIds):
    """A parameter set as ``GET /parameter-sets/{id}`` and ``magcal calibrate --json`` give it."""

    status: str
    verdict: VerdictRecord
    data_from: str
    data_until: str
    method: str
    field_model: str
    orbit_model: str
    parameters: ParametersRecord
    standard_errors: ParametersRecord
    formal_standard_errors: ParametersRecord
    parameter_names: list[str]
    covariance: list[list[float | None]]
    matrix: list[list[float]]
    correction_matrix: list[list[float]]
    candidates: list[dict[str, object]]
    statistics: StatisticsRecord
    observability: ObservabilityRecord
    warnings: list[str]
    provenance: ProvenanceRecord


class SetHistory(TypedDict):
    """What a figure over time shows of a parameter set."""

    verdict: VerdictRecord
    data_from: str
    data_until: str
    parameters: ParametersRecord
    standard_errors: ParametersRecord
    formal_standard_errors: ParametersRecord
    statistics: StatisticsRecord
    provenance: ProvenanceRecord


class SetSummary(SetHistory):
    """What a list of many parameter sets shows of each."""

    id: str
    magnetometer: str
    status: str
    method: str
    created_at: str
    field_model: str
    orbit_model: str


@cache
def _adapter() -> TypeAdapter[ParameterSetRecord]:
    return TypeAdapter(ParameterSetRecord)


def parse_parameter_set(text: str | bytes) -> ParameterSetRecord:
    """Return the parameter set in JSON ``text``.

    Raises
    ------
    InputError
        The text is not JSON or lacks what a parameter set has; the faults name the fields.
    """
    try:
        return _adapter().validate_json(text)
    except ValidationError as error:
        raise InputError("this is not a parameter set", _faults(error)) from error


def parameter_set_record(values: Mapping[str, object]) -> ParameterSetRecord:
    """Return ``values`` checked to be a parameter set.

    Raises
    ------
    InputError
        A field is missing or of another type; the faults name the fields.
    """
    try:
        return _adapter().validate_python(values)
    except ValidationError as error:
        raise InputError("this is not a parameter set", _faults(error)) from error


def _faults(error: ValidationError) -> list[Fault]:
    return [Fault(".".join(str(part) for part in one["loc"]) or "document", one["msg"]) for one in error.errors()]


def parameter_values(parameters: ParametersRecord) -> dict[str, float]:
    """Return every parameter by the name that it has in ``parameter_names``; NaN where the record has none."""
    groups = {
        "bias_nt": parameters["bias_nt"],
        "scale": parameters["scale"],
        "nonorthogonality_deg": parameters["nonorthogonality_deg"],
    } | {f"regressors.{name}": change for name, change in parameters["regressors"].items()}
    values = {
        f"{group}[{i}]": math.nan if value is None else value
        for group, found in groups.items()
        for i, value in enumerate(found)
    }
    if parameters["time_offset_s"] is not None:
        values["time_offset_s"] = parameters["time_offset_s"]
    return values


def oldest_orbit_days(record: SetHistory) -> float | None:
    """Return the largest distance in time of an orbit from the data, days; None where no orbit was used."""
    ages = [orbit.get("age_days") for orbit in record["provenance"].get("orbits", [])]
    known = [abs(age) for age in ages if isinstance(age, int | float)]
    return max(known) if known else None
