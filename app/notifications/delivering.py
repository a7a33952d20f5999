"""The deliveries: from the log to each webhook, at least once, in order per magnetometer, by one process at a time.

An event becomes one delivery a webhook in the transaction that moves the mark in the log. Of each lane (a magnetometer)
of a webhook, only the first that is pending is tried; those behind it wait until it has arrived or is parked.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from random import SystemRandom
from typing import Final

from sqlalchemy import and_, delete, func, select, update
from sqlalchemy.orm import Session

from app.notifications.sending import GONE, Outcome, Parcel
from app.notifications.tables import Delivery, Webhook
from app.outbox.events import Entry
from app.outbox.subscription import Subscriber
from app.storage.database import new_id, utc_now

FIRST_PAUSE_S: Final = 1.0
LONGEST_PAUSE_S: Final = 300.0
JITTER: Final = 0.2
MOST_DUE: Final = 200
AT_ONCE: Final = 4
"""Lanes of one webhook that are on their way at a time; one that gives no connection is tried with one."""


@dataclass(frozen=True, slots=True)
class Due:
    """A delivery whose turn it is."""

    delivery_id: str
    webhook_id: str
    attempts: int
    parcel: Parcel


def spread(session: Session, entry: Entry) -> None:
    """Make an event's deliveries: one for each webhook that wants its type and was there before it."""
    for hook in session.scalars(select(Webhook).where(Webhook.position < entry.position).order_by(Webhook.id)):
        if str(entry.event.type) in hook.events:
            now = utc_now()
            session.add(
                Delivery(
                    id=new_id(),
                    webhook_id=hook.id,
                    position=entry.position,
                    event_id=entry.event_id,
                    type=str(entry.event.type),
                    lane=entry.lane,
                    body=json.dumps(entry.body, separators=(",", ":"), allow_nan=False),
                    state="pending",
                    attempts=0,
                    next_attempt_at=now,
                    created_at=now,
                )
            )
    session.flush()


SPREADER: Final = Subscriber("webhooks", spread, from_the_start=True)
"""From the start: what a webhook is not told, because it was before it, its own position says."""


def due(session: Session, flying: Sequence[Due]) -> list[Due]:
    """Return the deliveries to try now: the first of each lane, a few a webhook, none of those that are ``flying``."""
    first = (
        select(Delivery.webhook_id, func.min(Delivery.position).label("position"))
        .where(Delivery.state == "pending")
        .group_by(Delivery.webhook_id, Delivery.lane)
        .subquery()
    )
    heads = (
        select(Delivery, Webhook)
        .join(first, and_(Delivery.webhook_id == first.c.webhook_id, Delivery.position == first.c.position))
        .join(Webhook, Webhook.id == Delivery.webhook_id)
        .where(Delivery.next_attempt_at <= utc_now(), Delivery.state == "pending")
        .order_by(Delivery.next_attempt_at, Delivery.position)
    )
    known = {one.delivery_id for one in flying}
    count: dict[str, int] = {}
    for one in flying:
        count[one.webhook_id] = count.get(one.webhook_id, 0) + 1
    found: list[Due] = []
    for row, hook in session.execute(heads.limit(MOST_DUE)):
        if row.id in known or count.get(hook.id, 0) >= (1 if hook.is_failing else AT_ONCE):
            continue
        count[hook.id] = count.get(hook.id, 0) + 1
        found.append(Due(row.id, hook.id, row.attempts, Parcel(hook.url, hook.secret, f"msg_{row.event_id}", row.body)))
    return found


def pause_s(attempts: int, outcome: Outcome) -> float:
    """Return how long to wait after the attempt number ``attempts``: longer each time, and as the receiver asks."""
    growing = min(FIRST_PAUSE_S * 2.0 ** min(attempts - 1, 20), LONGEST_PAUSE_S)
    jittered = growing * SystemRandom().uniform(1.0 - JITTER, 1.0 + JITTER)
    return max(jittered, outcome.retry_after_s or 0.0)


def settle(session: Session, one: Due, outcome: Outcome, begun: datetime, retry_hours: float) -> None:
    """Note what came of an attempt that was ``begun`` then; a replay asked for meanwhile begins anew all the same."""
    row = session.get(Delivery, one.delivery_id, with_for_update=True)
    if row is None or row.attempts != one.attempts or row.state != "pending":
        return
    now = utc_now()
    row.attempts += 1
    row.first_attempt_at = row.first_attempt_at or begun
    row.last_attempt_at, row.status, row.reason = begun, outcome.status, _short(outcome.reason)
    if outcome.is_delivered:
        row.state = "delivered"
    elif outcome.status == GONE or now - row.first_attempt_at >= timedelta(hours=retry_hours):
        row.state = "parked"
    else:
        row.next_attempt_at = now + timedelta(seconds=pause_s(row.attempts, outcome))
    session.flush()
    _note_health(session, one.webhook_id, outcome)


def _short(reason: str | None) -> str | None:
    return None if reason is None else reason[:500]


def _note_health(session: Session, webhook_id: str, outcome: Outcome) -> None:
    """Note whether the receiver can be reached; where it can be again, what waited for that is due at once."""
    hook = session.get(Webhook, webhook_id)
    if hook is None or hook.is_failing == (outcome.status is None):
        return
    hook.is_failing = outcome.status is None
    if not hook.is_failing:
        waits = (Delivery.webhook_id == webhook_id, Delivery.state == "pending", Delivery.status.is_(None))
        session.execute(
            update(Delivery)
            .where(*waits)
            .values(next_attempt_at=utc_now())
            .execution_options(synchronize_session=False)
        )


def forget_old(session: Session, keep_days: float) -> None:
    """Forget deliveries older than ``keep_days`` that are no longer on their way."""
    before = utc_now() - timedelta(days=keep_days)
    session.execute(
        delete(Delivery)
        .where(Delivery.state != "pending", Delivery.created_at < before)
        .execution_options(synchronize_session=False)
    )


def is_anybody_told(session: Session) -> bool:
    """Return whether there is a webhook at all."""
    return session.execute(select(Webhook.id).limit(1)).first() is not None
