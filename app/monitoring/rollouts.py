"""HTTP of what a set would change: the corrected field against the set in force, today and at the end of its life."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import numpy as np
from fastapi import APIRouter, Query
from pydantic import Field

from app.access.authentication import Reader
from app.http.dependencies import Db
from app.http.schemas import Filter, Record, UtcTime
from app.http.strict_json import StrictJsonRoute
from app.monitoring.trends import FIELD_NT, SHARE, LifeRead, stored_sets, trend_of
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from magcal_core.errors import BeyondHistoryError, OptionError, TooFewSetsError

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.trend import Trend

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["monitoring"])


class RolloutQuery(Filter):
    """From when on, and how far a set may be off."""

    at: str | None = Field(None, max_length=64, description="Time of the rollout; the end of the last set's data.")
    share: float = Field(SHARE, description="Share of the field that the error of a set may reach in its life.")


class ErrorsRead(Record):
    """Bound that the corrected field's error keeps in 95 of 100 cases, with the set and with the one in force."""

    at: UtcTime
    set_nt: float
    active_nt: float | None


class RolloutRead(Record):
    """What putting a set in force would change."""

    parameter_set_id: str
    active_id: str | None = Field(description="The set in force; null where none is, or where it is this one.")
    field_change_nt: float | None = Field(
        description="By how much the corrected field changes at 40,000 nT, root mean square over all directions."
    )
    field_change_error_nt: float | None
    life: LifeRead | None = Field(description="Null where there is no trend of three sets and more.")
    today: ErrorsRead | None
    at_end: ErrorsRead | None = Field(description="At the end of the life of the set.")
    text: str


@router.get("/{parameter_set_id}/rollout")
def get_rollout(parameter_set_id: str, query: Annotated[RolloutQuery, Query()], caller: Reader, db: Db) -> RolloutRead:
    """Say by how much the corrected field changes where a set comes into force, today and at the end of its life."""
    with db.read() as session:
        sets = ParameterSetRepository(session, caller)
        row = sets.get(parameter_set_id)
        active = sets.in_force(row.satellite_id, row.magnetometer_id)
        stored = stored_sets(session, row.satellite_id, row.magnetometer_id)
    active = None if active is not None and active.id == row.id else active
    try:
        found, why = trend_of(stored, query.at, query.share), ""
    except (TooFewSetsError, BeyondHistoryError, OptionError) as error:
        found, why = None, error.message
    return _rollout(row, active, found, why)


def _rollout(row: ParameterSet, active: ParameterSet | None, found: Trend | None, why: str) -> RolloutRead:
    change = None if active is None else _field_change(row, active)
    said = "no set is in force" if active is None else "the set in force is of another kind"
    if change is not None:
        said = f"the corrected field changes by {change[0]:.0f} +- {change[1]:.0f} nT"
    if found is None:
        text = f"{said}; how long it stays good cannot be told: {why}"
        return _read(row, active, change, None, None, None, text)
    life = found.life(_record(row))
    today = _errors(row, active, found, found.at_utc)
    at_end = None
    text = f"{said}; today it is off by at most {today.set_nt:.0f} nT"
    if today.active_nt is not None:
        text += f", with the set in force by {today.active_nt:.0f} nT"
    if life.until is not None and life.days:
        end = np.datetime64(life.until.rstrip("Z"), "ns")
        at_end = _errors(row, active, found, end)
        text += f"; {life.text}, until {life.until[:10]}"
        if at_end.active_nt is not None:
            text += f", when the set in force would be off by at most {at_end.active_nt:.0f} nT"
    else:
        text += f"; {life.text}"
    return _read(row, active, change, LifeRead.model_validate(life.to_dict()), today, at_end, text)


def _read(  # noqa: PLR0917
    row: ParameterSet,
    active: ParameterSet | None,
    change: tuple[float, float] | None,
    life: LifeRead | None,
    today: ErrorsRead | None,
    at_end: ErrorsRead | None,
    text: str,
) -> RolloutRead:
    return RolloutRead(
        parameter_set_id=row.id,
        active_id=None if active is None else active.id,
        field_change_nt=None if change is None else change[0],
        field_change_error_nt=None if change is None else change[1],
        life=None if life is None else life.model_copy(update={"parameter_set_id": row.id}),
        today=today,
        at_end=at_end,
        text=f"{text}.",
    )


def _field_change(row: ParameterSet, active: ParameterSet) -> tuple[float, float] | None:
    """Return the change of the corrected field and its error, nT; None where the two cannot be compared."""
    from magcal_core.calibration.sessions.monitoring import ActiveSet
    from magcal_core.calibration.verdict.agreement import agreement_with

    before, after = (ActiveSet.from_record(one.record) for one in (active, row))
    found = agreement_with(before, after.parameters, after.covariance, FIELD_NT, is_vector=after.is_vector)
    return None if found is None else (found.field_change_nt, found.field_change_error_nt)


def _errors(row: ParameterSet, active: ParameterSet | None, found: Trend, at_utc: np.datetime64) -> ErrorsRead:
    of_set = found.error_bound_nt(_record(row), at_utc)
    of_active = None if active is None else found.error_bound_nt(_record(active), at_utc)
    time: datetime = at_utc.astype("datetime64[us]").item()
    return ErrorsRead(at=time.replace(tzinfo=UTC), set_nt=of_set, active_nt=of_active)


def _record(row: ParameterSet) -> Mapping[str, object]:
    return {"parameters": row.record["parameters"]}
