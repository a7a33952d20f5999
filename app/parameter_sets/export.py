"""A parameter set written for flight software, in the convention that it wants."""

from __future__ import annotations

import csv
import io
import json
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from typing import Final

import numpy as np
import yaml

from app.http.schemas import utc_text
from app.parameter_sets.correction import rotation_of
from app.parameter_sets.flight_tables import Document, flight_numbers, fprime_parameters, gomspace_table
from app.parameter_sets.fprime_file import parameter_file
from app.parameter_sets.schemas import ParameterSetRead
from app.parameter_sets.worked_example import COLUMN, formula, rotation_of_symmetric, worked
from magcal_core.sensor.conventions import convert
from magcal_core.sensor.model import SensorModel

ON_BOARD: Final = "on-board"
FPRIME_FILE: Final = "fprime-dat"
FPRIME_MEDIA_TYPE: Final = "application/octet-stream"
FLIGHT_TABLES: Final = frozenset({"gomspace", "fprime", FPRIME_FILE})


def exported(
    record: ParameterSetRead, convention: str, form: str, *, first_id: int = 0, has_crc: bool = True
) -> tuple[str, str | bytes]:
    """Return the media type and the content of a parameter set in ``convention`` and in the format ``form``.

    The tables of flight software have one convention, ``on-board``, whatever is asked for. A parameter file of F Prime
    has ids from ``first_id`` on.

    Raises
    ------
    OptionError
        The convention is unknown.
    """
    if form == FPRIME_FILE:
        numbers = flight_numbers(document_of(record, ON_BOARD))
        return FPRIME_MEDIA_TYPE, parameter_file(numbers, first_id, has_crc=has_crc)
    media_type, write = EXPORTERS[form]
    return media_type, write(document_of(record, ON_BOARD if form in FLIGHT_TABLES else convention))


def document_of(record: ParameterSetRead, convention: str) -> Document:
    """Return what an export in ``convention`` holds, before it is written."""
    exact = record.parameters.model_dump()
    parameters = convert(exact, "exact", convention)
    if convention == "symmetric":
        parameters["rotation"] = rotation_of_symmetric(record.correction_matrix, parameters["matrix"])
    sensor = SensorModel(*(np.array(exact[name]) for name in ("bias_nt", "scale", "nonorthogonality_deg")))
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


def _json(document: Document) -> str:
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def _yaml(document: Document) -> str:
    text: str = yaml.safe_dump(dict(document), sort_keys=False, allow_unicode=True)
    return text


def _csv(document: Document) -> str:
    """Return one line a number: name, value."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["name", "value"])
    writer.writerows(_leaves("", document))
    return out.getvalue()


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), one)
    elif isinstance(value, list):
        for number, one in enumerate(value):
            yield from _leaves(f"{name}[{number}]", one)
    elif isinstance(value, float):
        yield name, repr(value)
    else:
        yield name, "" if value is None else value


def _c_header(document: Document) -> str:
    guard = f"MAGCAL_{_macro(document['satellite'])}_{_macro(document['magnetometer'])}_H"
    told = {name: value for name, value in document.items() if isinstance(value, str)}
    about = [f" * {name}: {value.replace('*/', '* /').replace('/*', '/ *')}" for name, value in told.items()]
    parameters = document["parameters"]
    arrays = dict(parameters) if isinstance(parameters, Mapping) else {}
    arrays["correction_matrix"] = document["correction_matrix"]
    arrays["worked"] = document["worked_example"]
    lines = [
        "/* magcal parameter set.",
        *(
            line
            for text in about
            for line in textwrap.wrap(text, 110, subsequent_indent=" *   ", break_long_words=False)
        ),
        " * MAGCAL_WORKED_RAW_NT put through the formula gives MAGCAL_WORKED_CORRECTED_NT.",
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
        *(line for name, value in arrays.items() for line in _c_constants(f"MAGCAL_{_macro(name)}", value)),
        "",
        f"#endif /* {guard} */",
    ]
    return "\n".join(lines) + "\n"


def _c_constants(name: str, value: object) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _c_constants(f"{name}_{_macro(key)}", one)
    elif isinstance(value, list):
        sizes = f"[{len(value)}]" + (f"[{len(value[0])}]" if value and isinstance(value[0], list) else "")
        yield f"static const double {name}{sizes} = {_c_list(value)};"
    elif isinstance(value, float | int):
        yield f"static const double {name} = {value!r};"


def _c_list(value: object) -> str:
    return "{" + ", ".join(map(_c_list, value)) + "}" if isinstance(value, list) else repr(value)


def _macro(name: object) -> str:
    return re.sub(r"[^A-Z0-9]", "_", str(name).upper())


EXPORTERS: Final[Mapping[str, tuple[str, Callable[[Document], str]]]] = {
    "json": ("application/json", _json),
    "csv": ("text/csv; charset=utf-8", _csv),
    "yaml": ("application/yaml", _yaml),
    "c": ("text/x-c; charset=utf-8", _c_header),
    "gomspace": ("text/plain; charset=utf-8", gomspace_table),
    "fprime": ("application/json", fprime_parameters),
}
"""Format -> media type and writer; the parameter file of F Prime, which is no text, beside them."""
