"""Many parameter sets at once: of each record only what a history shows, taken out by the database."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.parameter_sets.tables import ParameterSet
from app.records import SetSummary
from app.schemas import utc_text


def summaries(session: Session, set_ids: Sequence[str]) -> list[SetSummary]:
    """Return what a history shows of parameter sets, in the order of ``set_ids``.

    A record is mostly covariance, candidates and provenance: reading whole ones into objects takes five times as long.
    """
    row_of, record = ParameterSet, ParameterSet.record
    statement = select(
        *(row_of.id, row_of.magnetometer_id, row_of.status, row_of.method),
        *(row_of.data_from, row_of.data_until, row_of.created_at),
        *(record[name].label(name) for name in ("verdict", "field_model", "orbit_model", "parameters", "statistics")),
        *(record[name].label(name) for name in ("standard_errors", "formal_standard_errors")),
        record["provenance"]["orbits"].label("orbits"),
    ).where(row_of.id.in_(set_ids))
    found: dict[str, SetSummary] = {}
    for row in session.execute(statement):
        found[row.id] = {
            "id": row.id,
            "magnetometer": row.magnetometer_id,
            "status": row.status,
            "method": row.method,
            "created_at": utc_text(row.created_at),
            "data_from": utc_text(row.data_from),
            "data_until": utc_text(row.data_until),
            "verdict": row.verdict,
            "field_model": row.field_model,
            "orbit_model": row.orbit_model,
            "parameters": row.parameters,
            "standard_errors": row.standard_errors,
            "formal_standard_errors": row.formal_standard_errors,
            "statistics": row.statistics,
            "provenance": {"orbits": row.orbits or []},
        }
    return [found[set_id] for set_id in set_ids]
