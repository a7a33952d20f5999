"""A parameter set written for flight software, in the convention that it wants."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from app.http.schemas import utc_text
from app.parameter_sets.correction import rotation_of
from app.parameter_sets.export_formats import EXPORTERS
from app.parameter_sets.flight_tables import Document, flight_numbers
from app.parameter_sets.fprime_file import FPRIME_FILE, parameter_file
from app.parameter_sets.schemas import ParameterSetRead
from app.parameter_sets.worked_example import COLUMN, formula, rotation_of_symmetric, worked
from magcal_core.sensor.conventions import convert
from magcal_core.sensor.parameters import Parameters


def exported(
    record: ParameterSetRead, convention: str, form: str, *, first_id: int = 0, has_crc: bool = True
) -> tuple[str, str | bytes]:
    """Return the media type and the content of a parameter set in ``convention`` and in the format ``form``.

    The tables of flight software have one convention, ``on-board``, whatever is asked for.

    Raises
    ------
    OptionError
        The convention is unknown.
    """
    chosen = EXPORTERS[form]
    document = document_of(record, chosen.convention or convention)
    if form == FPRIME_FILE:
        return chosen.media_type, parameter_file(flight_numbers(document), first_id, has_crc=has_crc)
    return chosen.media_type, chosen.write(document)


def document_of(record: ParameterSetRead, convention: str) -> Document:
    """Return what an export in ``convention`` holds, before it is written."""
    exact = record.parameters.model_dump()
    parameters = convert(exact, "exact", convention)
    if convention == "symmetric":
        parameters["rotation"] = rotation_of_symmetric(record.correction_matrix, parameters["matrix"])
    sensor = Parameters.from_record({"parameters": exact}).sensor
    base = {name: exact[name] for name in ("time_base_utc",) if name in exact}
    return {
        "id": record.id,
        "satellite": record.satellite,
        "magnetometer": record.magnetometer,
        "created_at": utc_text(record.created_at),
        "data_from": utc_text(record.data_from),
        "data_until": utc_text(record.data_until),
        "method": record.method,
        "field_model": record.field_model,
        "verdict": record.verdict.grade,
        "convention": convention,
        **base,
        "formula": formula(
            convention,
            list(exact["regressors"]),
            is_since="time_base_utc" in exact,
            is_full=bool(np.triu(record.matrix, 1).any()),
        ),
        "parameters": parameters,
        "correction_matrix": record.correction_matrix,
        "worked_example": {
            "regressors": dict.fromkeys(exact["regressors"], COLUMN),
            **asdict(worked(sensor, exact["regressors"], rotation_of(record.matrix))),
        },
    }
