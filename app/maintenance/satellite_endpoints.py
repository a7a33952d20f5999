"""HTTP of removing a satellite with all it has."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import Field

from app.access.authentication import Administrator
from app.access.key_endpoints import refuse_bound
from app.http.dependencies import Blobs, Db
from app.http.schemas import Record, Slug
from app.http.strict_json import StrictJsonRoute
from app.maintenance.removal import remove_objects
from app.maintenance.satellite_removal import holdings_of, remove_satellite

router = APIRouter(route_class=StrictJsonRoute, tags=["satellites"])


class SatelliteRemoval(Record):
    """What a satellite has, or had before it was removed."""

    satellite: str
    is_removed: bool
    confirm: str = Field(description="To be given back to remove exactly this.")
    magnetometers: int
    sessions: int
    size_bytes: int
    orbits: int
    parameter_sets: int
    jobs: int
    unended_jobs: int = Field(description="Of them: waiting or running; they are cancelled.")


@router.delete("/satellites/{satellite_id}")
def delete_satellite(
    satellite_id: Slug,
    caller: Administrator,
    db: Db,
    store: Blobs,
    confirm: Annotated[
        str | None, Query(max_length=64, description="`confirm` of the answer without it; unset: nothing is removed.")
    ] = None,
) -> SatelliteRemoval:
    """Show what a satellite has and, with `confirm`, remove it with all of that; its lines of the audit trail stay."""
    with db.read() as session:
        found = holdings_of(session, caller, satellite_id)
    refuse_bound(caller)
    if confirm is not None:
        with db.write() as session:
            found = remove_satellite(session, caller, satellite_id, confirm)
        remove_objects(db, store)
    told = found.confirmation(satellite_id)
    return SatelliteRemoval(satellite=satellite_id, is_removed=confirm is not None, confirm=told, **asdict(found))
