"""HTTP of what flies: an activation is an intention; here is told how far it has come."""

from __future__ import annotations

from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Response

from app.aboard.repository import AboardRepository
from app.aboard.schemas import AboardBody, AboardQuery, AboardRead, AboardShort
from app.access.authentication import Operator, Reader
from app.http.dependencies import Db
from app.http.paging import answered
from app.http.schemas import Page
from app.http.strict_json import StrictJsonRoute
from app.parameter_sets.export_formats import EXPORTERS
from app.parameter_sets.schemas import ExportQuery

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["parameter sets"])


EXPORTS: Final[dict[int | str, dict[str, Any]]] = {200: {"content": {one.media_type: {} for one in EXPORTERS.values()}}}


@router.get("/{parameter_set_id}/export", response_class=Response, responses=EXPORTS)
def export_parameter_set(
    parameter_set_id: str, query: Annotated[ExportQuery, Query()], caller: Reader, db: Db
) -> Response:
    """Write a parameter set for flight software; of one in force it is noted that it was exported."""
    with db.read() as session:
        media_type, content, is_first = AboardRepository(session, caller).export(parameter_set_id, query)
    if is_first:
        with db.write() as session:
            AboardRepository(session, caller).note_exported(parameter_set_id)
    return Response(content, media_type=media_type)


@router.post("/{parameter_set_id}/aboard")
def report_aboard(parameter_set_id: str, body: AboardBody, caller: Operator, db: Db) -> AboardRead:
    """Compare what was read back from the flight computer with a parameter set, number by number, or note its state."""
    with db.write() as session:
        return AboardRepository(session, caller).report(parameter_set_id, body)


@router.get("/{parameter_set_id}/aboard", response_model=Page[AboardRead] | Page[AboardShort])
def list_aboard(parameter_set_id: str, query: Annotated[AboardQuery, Query()], caller: Reader, db: Db) -> Response:
    """List what is known of a parameter set's way into orbit, the newest first."""
    with db.read() as session:
        return answered(AboardRepository(session, caller).history(parameter_set_id, query))
