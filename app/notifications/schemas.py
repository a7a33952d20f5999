"""Bodies of the webhooks' calls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from app.http.schemas import Body, Name, PageQuery, Record, UtcTime
from app.outbox.events import EventType

DeliveryState = Literal["pending", "delivered", "parked"]


class WebhookCreate(Body):
    """Where to send what happens, and what of it."""

    url: Annotated[str, StringConstraints(min_length=1, max_length=1000)]
    events: list[Annotated[EventType, Field(strict=False)]] = Field(min_length=1, max_length=len(EventType))
    description: Name | None = None


class WebhookRead(Record):
    """A webhook; its secret is not shown again."""

    id: str
    url: str
    events: list[EventType]
    description: str | None
    is_failing: bool = Field(description="The last attempt got no connection.")
    created_at: UtcTime
    created_by: str | None


class WebhookCreated(WebhookRead):
    """A new webhook with its secret, `whsec_...`, in the only answer that has it."""

    secret: str


class DeliveryQuery(PageQuery):
    """Which deliveries to list."""

    state: DeliveryState | None = None


class DeliveryRead(Record):
    """One event on its way to a webhook."""

    id: str
    webhook_id: str
    event_id: str
    type: EventType
    state: DeliveryState
    attempts: int
    status: int | None = Field(description="HTTP status of the last answer.")
    reason: str | None = Field(description="Why the last attempt was no delivery.")
    first_attempt_at: UtcTime | None
    last_attempt_at: UtcTime | None
    next_attempt_at: UtcTime
    created_at: UtcTime
    body: str
