"""The audit trail: who did what, written in the transaction that did it."""

from __future__ import annotations

from datetime import datetime
from typing import Final

from sqlalchemy import Index, String
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.access.caller import Caller
from app.storage.database import Base, new_id, utc_now


def record_event(session: Session, caller: Caller, action: str, subject: str, satellite_id: str | None = None) -> None:
    """Add one line to the audit trail, in the transaction of what it tells of."""
    session.connection().execute(NEW_EVENT, event_of(caller, action, subject, satellite_id))


def event_of(caller: Caller, action: str, subject: str, satellite_id: str | None = None) -> dict[str, object]:
    """Return one line of the audit trail, for `NEW_EVENT`."""
    return {
        "id": new_id(),
        "at": utc_now(),
        "key_id": caller.key_id,
        "action": action,
        "subject": subject,
        "satellite_id": satellite_id,
        "address": caller.address,
        "request_id": caller.request_id,
    }


class AuditEvent(Base):
    """One thing that somebody did: who, what, to which, when, from where."""

    __tablename__ = "audit_event"
    __table_args__ = (Index(None, "satellite_id", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    at: Mapped[datetime]
    key_id: Mapped[str | None] = mapped_column(String(32))
    action: Mapped[str] = mapped_column(String(64))
    subject: Mapped[str] = mapped_column(String(200))
    satellite_id: Mapped[str | None] = mapped_column(String(63))
    address: Mapped[str | None] = mapped_column(String(64))
    request_id: Mapped[str | None] = mapped_column(String(64))


NEW_EVENT: Final = AuditEvent.metadata.tables["audit_event"].insert()
"""Without the mapper: every upload has its line of the trail."""
