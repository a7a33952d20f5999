"""Tables in answers: which format the caller accepts, and how it is written."""

from __future__ import annotations

from typing import Annotated, Any, Final

import pyarrow as pa
from fastapi import Request, Response

from app.errors import NotAcceptableError
from app.http.schemas import OneOf
from magcal_core.telemetry import MEDIA_TYPES, READERS, WRITERS
from magcal_core.telemetry.formats import media_type_of

TableFormat = Annotated[str, OneOf(WRITERS)]
"""A format that tables are written in."""

ANYTHING: Final = frozenset({"*/*", "text/*", "application/*"})
WRITTEN_TYPES: Final = {kind: form for kind, form in MEDIA_TYPES.items() if form in WRITERS}
READ_TYPES: Final = {kind: form for kind, form in MEDIA_TYPES.items() if form in READERS}
"""Media types of tables that magcal writes, and of telemetry that it reads -> format."""
OWN_TYPES: Final = {name: media_type_of(name) for name in WRITERS}
"""Format -> the media type that magcal answers with."""


def wanted_format(request: Request, asked: str | None, default: str) -> str:
    """Return the format of an answer: what the query asks for, else what ``Accept`` likes best, else ``default``.

    Raises
    ------
    NotAcceptableError
        None of the accepted media types can be written.
    """
    if asked is not None:
        return asked
    liked = [_weighed(part) for part in request.headers.get("accept", "*/*").split(",")]
    for quality, media_type in sorted(liked, key=lambda one: -one[0]):
        if quality <= 0:
            continue
        if media_type in WRITTEN_TYPES:
            return WRITTEN_TYPES[media_type]
        if media_type in ANYTHING:
            return "csv" if media_type == "text/*" else default
    raise NotAcceptableError(f"none of the accepted media types can be written; known are {', '.join(WRITTEN_TYPES)}")


def _weighed(part: str) -> tuple[float, str]:
    media_type, *parameters = (piece.strip().lower() for piece in part.split(";"))
    weights = [parameter[2:] for parameter in parameters if parameter.startswith("q=")]
    try:
        return (float(weights[0]) if weights else 1.0), media_type
    except ValueError:
        return 0.0, media_type


def table_response(content: bytes, form: str, name: str) -> Response:
    """Return the answer that carries a written table; ``name`` is what a browser would save it as."""
    disposition = f'attachment; filename="{name}.{form}"'
    return Response(content, media_type=OWN_TYPES[form], headers={"Content-Disposition": disposition, "Vary": "Accept"})


def write_table(table: pa.Table, form: str) -> bytes:
    """Return an Arrow table in the format ``form``."""
    return WRITERS[form](table)


BYTES: Final = "application/octet-stream"
"""Of no format by its name: it is told by how the bytes begin.

It stands last, for some generated clients send bytes under the last type that a call takes.
"""


TELEMETRY_BODY: Final = {
    "requestBody": {
        "description": "The telemetry; gzip and zstd as Content-Encoding.",
        "required": True,
        "content": {kind: {"schema": {"type": "string", "format": "binary"}} for kind in (*READ_TYPES, BYTES)},
    }
}


COLUMNS: Final = {"type": "object", "additionalProperties": {"type": "array", "items": {}}}


TABLES: Final[dict[int | str, dict[str, Any]]] = {
    200: {
        "description": "The table.",
        "content": {
            kind: {"schema": COLUMNS if form == "json" else {"type": "string"}} for kind, form in WRITTEN_TYPES.items()
        },
    }
}
