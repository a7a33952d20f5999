"""HTTP of what flies: an activation is an intention; here is told how far it has come."""

from __future__ import annotations

from fastapi import APIRouter

from app.aboard.repository import AboardRepository
from app.aboard.schemas import AboardBody, AboardHistory, AboardRead
from app.access.authentication import Operator, Reader
from app.http.dependencies import Db
from app.http.strict_json import StrictJsonRoute

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["parameter sets"])


@router.post("/{parameter_set_id}/aboard")
def report_aboard(parameter_set_id: str, body: AboardBody, caller: Operator, db: Db) -> AboardRead:
    """Compare what was read back from the flight computer with a parameter set, number by number, or note its state."""
    with db.write() as session:
        return AboardRepository(session, caller).report(parameter_set_id, body)


@router.get("/{parameter_set_id}/aboard")
def list_aboard(parameter_set_id: str, caller: Reader, db: Db) -> AboardHistory:
    """List what is known of a parameter set's way into orbit, the newest first."""
    with db.read() as session:
        return AboardHistory(items=AboardRepository(session, caller).history(parameter_set_id))
