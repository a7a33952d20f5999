"""Many parameter sets at once: of each record only what a history shows, taken out by the database."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from pydantic_core import from_json
from sqlalchemy import Connection, Text, cast, func, select
from sqlalchemy.orm import Session
from sqlalchemy.sql.elements import ColumnElement

from app.http.schemas import utc_text
from app.parameter_sets.tables import ParameterSet
from app.records.parameter_set import SetSummary

SHOWN: Final = (
    "verdict",
    "field_model",
    "orbit_model",
    "parameters",
    "standard_errors",
    "formal_standard_errors",
    "statistics",
)

Residuals = tuple[float | None, float | None]
"""RMS after the calibration, and cross-validated, nT."""


def summaries(session: Session, set_ids: Sequence[str]) -> list[SetSummary]:
    """Return what a history shows of parameter sets, in the order of ``set_ids``.

    A record is mostly covariance, candidates and provenance: reading whole ones into objects takes five times as long.
    What is shown comes as one text a record, which is read once.
    """
    row_of = ParameterSet
    statement = select(
        *(row_of.id, row_of.magnetometer_id, row_of.status, row_of.method),
        *(row_of.data_from, row_of.data_until, row_of.created_at),
        _shown(session.connection()).label("shown"),
    ).where(row_of.id.in_(set_ids))
    found: dict[str, SetSummary] = {}
    for row in session.execute(statement):
        *shown, orbits, options = from_json(row.shown)
        verdict, field_model, orbit_model, parameters, standard_errors, formal_standard_errors, statistics = shown
        found[row.id] = {
            "id": row.id,
            "magnetometer": row.magnetometer_id,
            "status": row.status,
            "method": row.method,
            "created_at": utc_text(row.created_at),
            "data_from": utc_text(row.data_from),
            "data_until": utc_text(row.data_until),
            "verdict": verdict,
            "field_model": field_model,
            "orbit_model": orbit_model,
            "parameters": parameters,
            "standard_errors": standard_errors,
            "formal_standard_errors": formal_standard_errors,
            "statistics": statistics,
            "provenance": {"orbits": orbits or [], "options": options or {}},
        }
    return [found[set_id] for set_id in set_ids]


def residuals_of(session: Session, set_ids: Sequence[str]) -> dict[str, Residuals]:
    """Return the residuals of parameter sets by their ids; None for what a record does not hold."""
    record = ParameterSet.record
    statement = select(
        ParameterSet.id,
        record["statistics"]["after"]["rms_nt"].as_float(),
        record["statistics"]["cross_validated_rms_nt"].as_float(),
    ).where(ParameterSet.id.in_(set_ids))
    return {set_id: (rms_nt, validated_nt) for set_id, rms_nt, validated_nt in session.execute(statement)}


def _shown(connection: Connection) -> ColumnElement[str]:
    """Return the text of a JSON array of what is `SHOWN` of a record, its orbits and options."""
    record = ParameterSet.record
    if connection.dialect.name == "postgresql":
        parts = (*(record[name] for name in SHOWN), record["provenance"]["orbits"], record["provenance"]["options"])
        return cast(func.jsonb_build_array(*parts), Text)
    paths = (*(f"$.{name}" for name in SHOWN), "$.provenance.orbits", "$.provenance.options")
    return func.json_extract(cast(record, Text), *paths, type_=Text)
