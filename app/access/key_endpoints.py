"""HTTP of the keys and of the audit trail; all of it needs the scope ``admin``."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from sqlalchemy import select

from app.access.audit_trail import AuditEvent
from app.access.authentication import AccessServices, Administrator
from app.access.caller import Caller
from app.access.key_repository import KeyRepository
from app.access.key_schemas import AuditQuery, AuditRead, AuditShort, KeyCreate, KeyCreated, KeyQuery, KeyRead, KeyShort
from app.errors import ScopeRequiredError
from app.http.dependencies import Db
from app.http.paging import Ways, answered, fetch_page, page_of
from app.http.schemas import Page
from app.http.services import services_of
from app.http.strict_json import StrictJsonRoute
from app.storage.database import Database

router = APIRouter(route_class=StrictJsonRoute, tags=["keys"])

TRAIL: Final = Ways(
    {"at": (AuditEvent.id,)},
    searched=(AuditEvent.action, AuditEvent.subject, AuditEvent.satellite_id, AuditEvent.key_id, AuditEvent.reason),
)


def refuse_bound(caller: Caller) -> None:
    """Refuse a key that is bound to satellites what concerns the service as a whole."""
    if caller.satellites is not None:
        raise ScopeRequiredError("the key needs the scope admin for all satellites")


@router.post("/keys", status_code=201)
def create_key(body: KeyCreate, caller: Administrator, db: Db) -> KeyCreated:
    """Make a key; its secret is in this answer and nowhere else."""
    refuse_bound(caller)
    with db.write() as session:
        made = KeyRepository(session, caller).create(body.scopes, body.satellites, body.expires_at, body.name)
    return KeyCreated(key=made.key, **KeyRead.model_validate(made.row).model_dump())


@router.get("/keys", response_model=Page[KeyRead] | Page[KeyShort])
def list_keys(query: Annotated[KeyQuery, Query()], caller: Administrator, db: Db) -> Response:
    """List the keys, the newest first."""
    return answered(keys_now(query, caller, db))


def keys_now(query: KeyQuery, caller: Caller, db: Database) -> Page[KeyRead] | Page[KeyShort]:
    """Return a part of the keys."""
    refuse_bound(caller)
    with db.read() as session:
        found = KeyRepository(session, caller).page(query)
    return page_of([KeyRead.model_validate(row) for row in found.rows], found, query, KeyShort)


@router.post("/keys/{key_id}/revoke")
def revoke_key(key_id: str, request: Request, caller: Administrator, db: Db) -> KeyRead:
    """Revoke a key from the next request on, in other processes within a second."""
    refuse_bound(caller)
    with db.write() as session:
        revoked = KeyRead.model_validate(KeyRepository(session, caller).revoke(key_id))
    services_of(request.app, AccessServices).recent_keys.forget()
    return revoked


@router.get("/audit", response_model=Page[AuditRead] | Page[AuditShort])
def list_audit(query: Annotated[AuditQuery, Query()], caller: Administrator, db: Db) -> Response:
    """List who did what, the newest first."""
    refuse_bound(caller)
    with db.read() as session:
        found = fetch_page(session, select(AuditEvent), TRAIL, query)
    return answered(page_of([AuditRead.model_validate(row) for row in found.rows], found, query, AuditShort))
