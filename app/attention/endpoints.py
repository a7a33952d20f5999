"""HTTP of what needs attention, and of the fleet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from app.access.authentication import Operator, Reader
from app.access.caller import Caller
from app.attention.entries import Fleet
from app.attention.fleet import fleet_page
from app.attention.repository import AttentionRepository
from app.attention.schemas import (
    AcknowledgeBody,
    AttentionPage,
    AttentionQuery,
    AttentionRead,
    AttentionShortPage,
    FleetPage,
    FleetQuery,
    FleetShortPage,
)
from app.http.dependencies import Db
from app.http.entity_tags import UNCHANGED, revalidated
from app.http.schemas import Identifier
from app.http.services import services_of
from app.http.strict_json import StrictJsonRoute
from app.storage.database import Database

router = APIRouter(route_class=StrictJsonRoute, tags=["attention"])


@dataclass(frozen=True, kw_only=True)
class AttentionServices:
    """What attention adds to what the application holds."""

    fleet: Fleet


async def _fleet(request: Request) -> Fleet:
    return services_of(request.app, AttentionServices).fleet


Known = Annotated[Fleet, Depends(_fleet)]


@router.get("/attention", response_model=AttentionPage | AttentionShortPage, responses=UNCHANGED)
def list_attention(
    query: Annotated[AttentionQuery, Query()], request: Request, caller: Reader, db: Db, fleet: Known
) -> Response:
    """List what needs attention, the worst first: one entry a magnetometer and cause, each with what mends it."""
    return revalidated(request, attention_now(query, caller, db, fleet))


def attention_now(
    query: AttentionQuery, caller: Caller, db: Database, fleet: Fleet
) -> AttentionPage | AttentionShortPage:
    """Return what needs attention."""
    with db.read() as session:
        return AttentionRepository(session, caller, fleet).page(query)


@router.post("/attention/{entry_id}/acknowledge")
def acknowledge_attention(
    entry_id: Identifier, body: AcknowledgeBody, caller: Operator, db: Db, fleet: Known
) -> AttentionRead:
    """Say that somebody has seen an entry; it comes back once what it is about changes, gets worse, or time is up."""
    with db.write() as session:
        return AttentionRepository(session, caller, fleet).acknowledge(entry_id, body)


@router.get("/fleet", response_model=FleetPage | FleetShortPage, responses=UNCHANGED)
def list_fleet(
    query: Annotated[FleetQuery, Query()], request: Request, caller: Reader, db: Db, fleet: Known
) -> Response:
    """Show every magnetometer at a glance, searched, sorted and counted by the service."""
    return revalidated(request, fleet_now(query, caller, db, fleet))


def fleet_now(query: FleetQuery, caller: Caller, db: Database, fleet: Fleet) -> FleetPage | FleetShortPage:
    """Return the fleet at a glance."""
    with db.read() as session:
        return fleet_page(AttentionRepository(session, caller, fleet), query)
