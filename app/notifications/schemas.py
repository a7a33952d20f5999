"""Bodies of the webhooks' calls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from app.http.schemas import Body, Name, NewestFirst, Record, Search, UtcTime
from app.outbox.events import EventType

DeliveryState = Literal["pending", "delivered", "parked"]


class WebhookCreate(Body):
    """Where to send what happens, and what of it."""

    url: Annotated[str, StringConstraints(min_length=1, max_length=1000)]
    events: list[Annotated[EventType, Field(strict=False)]] = Field(min_length=1, max_length=len(EventType))
    description: Name | None = None


class WebhookQuery(NewestFirst):
    """Which webhooks to list."""

    q: Search | None = Field(None, description="Part of an id, address or description.")


class WebhookShort(Record):
    """A webhook without its address and types of events, in under 500 bytes."""

    id: str
    description: str | None
    is_failing: bool = Field(description="The last attempt got no connection.")
    created_at: UtcTime
    created_by: str | None


class WebhookRead(WebhookShort):
    """A webhook; its secret is not shown again."""

    url: str
    events: list[EventType]


class WebhookCreated(WebhookRead):
    """A new webhook with its secret, `whsec_...`, in the only answer that has it."""

    secret: str


class DeliveryQuery(NewestFirst):
    """Which deliveries to list."""

    q: Search | None = Field(None, description="Part of an id of the delivery or its event, a type or a reason.")

    state: DeliveryState | None = None


class DeliveryShort(Record):
    """One event on its way to a webhook, without what is sent, in under 500 bytes."""

    id: str
    webhook_id: str
    event_id: str
    type: EventType
    state: DeliveryState
    attempts: int
    status: int | None = Field(description="HTTP status of the last answer.")
    next_attempt_at: UtcTime
    created_at: UtcTime


class DeliveryRead(DeliveryShort):
    """One event on its way to a webhook."""

    reason: str | None = Field(description="Why the last attempt was no delivery.")
    first_attempt_at: UtcTime | None
    last_attempt_at: UtcTime | None
    body: str
