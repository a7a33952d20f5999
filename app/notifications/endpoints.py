"""HTTP of webhooks; all of it needs the scope ``admin`` for all satellites."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from app.access.authentication import Administrator
from app.access.caller import Caller
from app.errors import ScopeRequiredError
from app.http.dependencies import Config, Db
from app.http.paging import answered, page_of
from app.http.schemas import Page
from app.http.strict_json import StrictJsonRoute
from app.notifications import event_stream
from app.notifications.hosts import AddressRefusedError, AllowedHosts, WebhookHostError, target_of
from app.notifications.repository import WebhookRepository
from app.notifications.schemas import (
    DeliveryQuery,
    DeliveryRead,
    DeliveryShort,
    WebhookCreate,
    WebhookCreated,
    WebhookQuery,
    WebhookRead,
    WebhookShort,
)
from app.outbox.log import place_new

router = APIRouter(route_class=StrictJsonRoute, tags=["events"])


def _refuse_bound(caller: Caller) -> None:
    if caller.satellites is not None:
        raise ScopeRequiredError("the key needs the scope admin for all satellites")


def _check_target(url: str, listed: str) -> None:
    """Refuse an address that nothing would be sent to; one whose name cannot be looked up now may be so later."""
    try:
        AllowedHosts.of(listed).addresses(target_of(url))
    except AddressRefusedError as error:
        raise WebhookHostError("the host has a private address that MAGCAL_WEBHOOK_HOSTS does not name") from error
    except OSError:
        return


@router.post("/webhooks", status_code=201)
def create_webhook(body: WebhookCreate, caller: Administrator, db: Db, config: Config) -> WebhookCreated:
    """Have an address told what happens; the secret that signs it is in this answer and nowhere else."""
    _refuse_bound(caller)
    _check_target(body.url, config.webhook_hosts)
    place_new(db)
    with db.write() as session:
        row = WebhookRepository(session, caller).create(body)
    return WebhookCreated(secret=row.secret, **WebhookRead.model_validate(row).model_dump())


@router.get("/webhooks", response_model=Page[WebhookRead] | Page[WebhookShort])
def list_webhooks(query: Annotated[WebhookQuery, Query()], caller: Administrator, db: Db) -> Response:
    """List the webhooks, the newest first."""
    _refuse_bound(caller)
    with db.read() as session:
        found = WebhookRepository(session, caller).page(query)
    return answered(page_of([WebhookRead.model_validate(row) for row in found.rows], found, query, WebhookShort))


@router.delete("/webhooks/{webhook_id}", status_code=204)
def delete_webhook(webhook_id: str, caller: Administrator, db: Db) -> None:
    """Forget a webhook and its deliveries."""
    _refuse_bound(caller)
    with db.write() as session:
        WebhookRepository(session, caller).delete(webhook_id)


@router.get("/webhooks/{webhook_id}/deliveries", response_model=Page[DeliveryRead] | Page[DeliveryShort])
def list_deliveries(
    webhook_id: str, query: Annotated[DeliveryQuery, Query()], caller: Administrator, db: Db
) -> Response:
    """List what was sent to a webhook, or is to be, the newest first."""
    _refuse_bound(caller)
    with db.read() as session:
        found = WebhookRepository(session, caller).deliveries(webhook_id, query)
    return answered(page_of([DeliveryRead.model_validate(row) for row in found.rows], found, query, DeliveryShort))


@router.post("/webhooks/{webhook_id}/deliveries/{delivery_id}/replay", status_code=202)
def replay_delivery(webhook_id: str, delivery_id: str, caller: Administrator, db: Db) -> DeliveryRead:
    """Send an event once more, one that was parked or one that has arrived."""
    _refuse_bound(caller)
    with db.write() as session:
        return DeliveryRead.model_validate(WebhookRepository(session, caller).replay(webhook_id, delivery_id))


router.routes.extend(event_stream.router.routes)
