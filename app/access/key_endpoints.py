"""HTTP of the keys and of the audit trail; all of it needs the scope ``admin``."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request
from sqlalchemy import select

from app.access.audit_trail import AuditEvent
from app.access.authentication import AccessServices, Administrator
from app.access.caller import Caller
from app.access.key_repository import KeyRepository
from app.access.key_schemas import AuditRead, KeyCreate, KeyCreated, KeyRead
from app.errors import ScopeRequiredError
from app.http.dependencies import Db
from app.http.paging import fetch_page
from app.http.schemas import Page, PageQuery
from app.http.services import services_of
from app.http.strict_json import StrictJsonRoute

router = APIRouter(route_class=StrictJsonRoute, tags=["keys"])


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


@router.get("/keys")
def list_keys(query: Annotated[PageQuery, Query()], caller: Administrator, db: Db) -> Page[KeyRead]:
    """List the keys, the newest first."""
    refuse_bound(caller)
    with db.read() as session:
        rows, cursor, total = KeyRepository(session, caller).page(query)
    return Page(items=[KeyRead.model_validate(row) for row in rows], next=cursor, total=total)


@router.post("/keys/{key_id}/revoke")
def revoke_key(key_id: str, request: Request, caller: Administrator, db: Db) -> KeyRead:
    """Revoke a key from the next request on, in other processes within a second."""
    refuse_bound(caller)
    with db.write() as session:
        revoked = KeyRead.model_validate(KeyRepository(session, caller).revoke(key_id))
    services_of(request.app, AccessServices).recent_keys.forget()
    return revoked


@router.get("/audit")
def list_audit(query: Annotated[PageQuery, Query()], caller: Administrator, db: Db) -> Page[AuditRead]:
    """List who did what, the newest first."""
    refuse_bound(caller)
    with db.read() as session:
        rows, cursor, total = fetch_page(session, select(AuditEvent), (AuditEvent.id,), query)
    return Page(items=[AuditRead.model_validate(row) for row in rows], next=cursor, total=total)
