"""Webhooks and their deliveries, as administrators look after them."""

from __future__ import annotations

import base64
import secrets
from typing import Final

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import ConflictError, NotFoundError
from app.http.paging import Part, Ways, fetch_page
from app.notifications.schemas import DeliveryQuery, WebhookCreate, WebhookQuery
from app.notifications.tables import Delivery, Webhook
from app.outbox.log import newest_position
from app.storage.database import new_id, utc_now

SECRET_BYTES: Final = 32
MOST_WEBHOOKS: Final = 100
WEBHOOKS: Final = Ways({"created": (Webhook.id,)}, searched=(Webhook.id, Webhook.url, Webhook.description))
DELIVERIES: Final = Ways(
    {"created": (Delivery.id,)}, searched=(Delivery.id, Delivery.event_id, Delivery.type, Delivery.reason)
)


class WebhookRepository:
    """The webhooks of this service."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller

    def create(self, wanted: WebhookCreate) -> Webhook:
        """Return the new webhook ``wanted``, told of what happens from now on."""
        if len(self.session.scalars(select(Webhook.id).limit(MOST_WEBHOOKS)).all()) >= MOST_WEBHOOKS:
            raise ConflictError(f"there are {MOST_WEBHOOKS} webhooks already, which is the limit")
        row = Webhook(
            id=new_id(),
            url=wanted.url,
            events=[str(one) for one in dict.fromkeys(wanted.events)],
            description=wanted.description,
            secret=f"whsec_{base64.b64encode(secrets.token_bytes(SECRET_BYTES)).decode()}",
            position=newest_position(self.session),
            is_failing=False,
            created_at=utc_now(),
            created_by=self.caller.key_id,
        )
        self.session.add(row)
        record_event(self.session, self.caller, "webhook.create", row.id)
        return row

    def get(self, webhook_id: str) -> Webhook:
        """Return the webhook ``webhook_id``."""
        row = self.session.get(Webhook, webhook_id)
        if row is None:
            raise NotFoundError("no such webhook")
        return row

    def page(self, query: WebhookQuery) -> Part[Webhook]:
        """Return a part of the webhooks."""
        return fetch_page(self.session, select(Webhook), WEBHOOKS, query)

    def delete(self, webhook_id: str) -> None:
        """Forget a webhook and its deliveries."""
        row = self.get(webhook_id)
        self.session.execute(delete(Delivery).where(Delivery.webhook_id == row.id))
        self.session.delete(row)
        record_event(self.session, self.caller, "webhook.delete", webhook_id)

    def deliveries(self, webhook_id: str, query: DeliveryQuery) -> Part[Delivery]:
        """Return a part of a webhook's deliveries."""
        statement = select(Delivery).where(Delivery.webhook_id == self.get(webhook_id).id)
        if query.state is not None:
            statement = statement.where(Delivery.state == query.state)
        return fetch_page(self.session, statement, DELIVERIES, query)

    def replay(self, webhook_id: str, delivery_id: str) -> Delivery:
        """Return a delivery, to be sent once more from now on, for as long as a new one."""
        row = self.session.get(Delivery, delivery_id)
        if row is None or row.webhook_id != self.get(webhook_id).id:
            raise NotFoundError("the webhook has no such delivery")
        self.session.execute(
            update(Delivery)
            .where(Delivery.id == row.id)
            .values(state="pending", attempts=0, first_attempt_at=None, next_attempt_at=utc_now(), reason=None)
        )
        record_event(self.session, self.caller, "webhook.replay", row.id)
        self.session.flush()
        self.session.refresh(row)
        return row
