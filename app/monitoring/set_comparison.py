"""HTTP of two parameter sets held against each other: a word first, then what differs most, then every parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, Literal

from fastapi import APIRouter, Query
from pydantic import Field

from app.access.authentication import Reader
from app.http.dependencies import Db
from app.http.schemas import Filter, Identifier, Record
from app.http.strict_json import StrictJsonRoute
from app.monitoring.endpoints import DriftRead
from app.monitoring.trends import FIELD_NT
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from app.records.json_numbers import without_nan
from magcal_core.errors import MagcalError

if TYPE_CHECKING:
    from magcal_core.calibration.verdict.agreement import Agreement

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["monitoring"])

Word = Literal["same", "differs", "cannot_tell"]
HELD: Final = 1.96
"""Standard errors of the change of the field within which it lies in 95 of 100 cases."""


class SetComparisonQuery(Filter):
    """With which other set."""

    other: Identifier = Field(description="The set that this one is held against, of the same magnetometer.")


class SetComparisonRead(Record):
    """Whether two sets say the same of the sensor; differences are this set less the other."""

    parameter_set_id: str
    other_id: str
    word: Word = Field(
        description="`differs`: significantly, and by more than the limit; `same`: by less than the limit, with their "
        "errors; `cannot_tell`: their errors are larger than that, or they are of different kinds."
    )
    text: str
    parameter: str | None = Field(description="The parameter that differs most, in its standard errors.")
    sigmas: float | None = Field(description="By how many.")
    p_value: float | None = Field(description="Of a difference so significant in any of nine parameters by chance.")
    field_change_nt: float | None = Field(
        description="By how much the corrected field differs at 40,000 nT, root mean square over all directions."
    )
    field_change_error_nt: float | None
    limit_nt: float | None = Field(description="Change of the corrected field up to which it does not matter, nT.")
    differences: list[DriftRead]


@dataclass(frozen=True, slots=True)
class _Said:
    word: Word
    text: str


@router.get("/{parameter_set_id}/comparison")
def compare_parameter_sets(
    parameter_set_id: str, query: Annotated[SetComparisonQuery, Query()], caller: Reader, db: Db
) -> SetComparisonRead:
    """Say in a word whether two parameter sets say the same of the sensor, and which parameter differs most."""
    with db.read() as session:
        sets = ParameterSetRepository(session, caller)
        rows = [sets.get(one) for one in (parameter_set_id, query.other)]
        sessions = sets.session_ids(rows)
    row, other = rows
    shared = bool(set(sessions[row.id]) & set(sessions[other.id]))
    found, why = _agreement(row, other)
    said = _Said("cannot_tell", why) if found is None else _said(found, is_shared=shared)
    worst = None if found is None else found.differences[0]
    return SetComparisonRead(
        parameter_set_id=row.id,
        other_id=other.id,
        word=said.word,
        text=said.text,
        parameter=None if worst is None else worst.parameter,
        sigmas=None if worst is None else worst.sigmas,
        p_value=None if found is None else found.p_value,
        field_change_nt=None if found is None else found.field_change_nt,
        field_change_error_nt=None if found is None else found.field_change_error_nt,
        limit_nt=None if found is None else found.limit_nt,
        differences=[] if found is None else [_difference(one.to_dict()) for one in found.differences],
    )


def _difference(values: object) -> DriftRead:
    return DriftRead.model_validate(without_nan(values))


def _agreement(row: ParameterSet, other: ParameterSet) -> tuple[Agreement | None, str]:
    """Return what separates two sets; None, and why, where they cannot be compared."""
    from magcal_core.calibration.sessions.monitoring import ActiveSet
    from magcal_core.calibration.verdict.agreement import agreement_with

    if (row.satellite_id, row.magnetometer_id) != (other.satellite_id, other.magnetometer_id):
        return None, "Cannot tell: the two are of different magnetometers."
    try:
        made, before = (ActiveSet.from_record(one.record) for one in (row, other))
    except MagcalError as error:
        return None, f"Cannot tell: {error}."
    if min(made.covariance.diagonal().min(initial=0.0), before.covariance.diagonal().min(initial=0.0)) < 0.0:
        return None, "Cannot tell: a set has no errors: its covariance has a negative variance."
    found = agreement_with(before, made.parameters, made.covariance, FIELD_NT, is_vector=made.is_vector)
    why = (
        "Cannot tell: the two are of different kinds (|B| against components, or other regressors), or one has no "
        "errors; their parameters do not mean the same."
    )
    return found, "" if found is not None else why


def _said(found: Agreement, *, is_shared: bool) -> _Said:
    worst = found.differences[0]
    most = f"{worst.parameter} differs most, by {worst.difference:+.4g}, {worst.sigmas:.1f} sigma"
    size = f"the corrected field by {found.field_change_nt:.0f} +- {found.field_change_error_nt:.0f} nT"
    limit = f"limit {found.limit_nt:.0f} nT"
    shared = " They have telemetry in common, so that the true errors of the difference are smaller." * is_shared
    if found.is_material:
        return _Said("differs", f"Differs: {most}; {size}, {limit}.{shared}")
    if max(found.field_change_nt, HELD * found.field_change_error_nt) > found.limit_nt:
        return _Said("cannot_tell", f"Cannot tell: the errors are too large; {most}; {size}, {limit}.{shared}")
    return _Said("same", f"Same: {size}, {limit}; {most}.{shared}")
