"""The log of what happened: appended to in the transaction of what it tells, read in one order by everybody.

On PostgreSQL, transactions that write at the same time become visible in another order than their rows were numbered
in; a reader that goes by that number would pass over what is committed late. So rows are written without a position,
and whoever reads gives one, under a lock, to those that have become visible. What a transaction could only do once
another had ended (activations of one magnetometer, say) comes behind it. On SQLite one transaction writes at a time,
and entries have their position at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import timedelta
from typing import Final

from sqlalchemy import ColumnElement, and_, delete, func, insert, or_, select, text, true
from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.outbox.events import Entry, Event, EventType
from app.outbox.tables import OutboxEntry
from app.storage.database import Database, new_id, utc_now

OUTBOX: Final = OutboxEntry.metadata.tables["outbox"]
NEXT_POSITION: Final = select(func.coalesce(func.max(OUTBOX.c.position), 0) + 1).scalar_subquery()
APPEND: Final = {
    "sqlite": insert(OUTBOX).values(position=NEXT_POSITION),
    "postgresql": insert(OUTBOX),
}
"""Made once: every upload appends."""
ORDER_LOCK: Final = 0x6D61676F7264  # "magord", for pg_try_advisory_xact_lock
PLACE_NEW: Final = text(
    "UPDATE outbox SET position = placed.base + placed.number FROM ("
    "  SELECT id, row_number() OVER (ORDER BY id) AS number,"
    "  (SELECT coalesce(max(position), 0) FROM outbox) AS base FROM outbox WHERE position IS NULL"
    ") AS placed WHERE outbox.id = placed.id"
)
MOST_AT_ONCE: Final = 500


def append(session: Session, events: Iterable[Event]) -> None:
    """Write ``events`` into the log in the session's transaction: they have happened once it is committed."""
    now = utc_now()
    rows = [
        {
            "event_id": new_id(),
            "type": str(event.type),
            "at": now,
            "satellite_id": event.satellite_id,
            "magnetometer_id": event.magnetometer_id,
            "owner": event.owner,
            "data": dict(event.data),
        }
        for event in events
    ]
    if not rows:
        return
    connection = session.connection()
    statement = APPEND[connection.dialect.name]
    if connection.dialect.name == "postgresql":
        connection.execute(statement, rows)
    else:
        for row in rows:  # one by one: a position is that of the row before, and one more
            connection.execute(statement, row)


def place_new(database: Database) -> None:
    """Give a position to what has been committed without one."""
    if database.is_sqlite:
        return
    waiting = select(OUTBOX.c.id).where(OUTBOX.c.position.is_(None)).limit(1)
    with database.read() as session:
        if session.execute(waiting).first() is None:
            return
    database.transact(_place)


def _place(session: Session) -> None:
    is_mine = session.scalar(select(func.pg_try_advisory_xact_lock(ORDER_LOCK)))
    if is_mine:
        session.execute(PLACE_NEW)


def newest_position(session: Session) -> int:
    """Return the position of the newest entry, 0 where there has been none."""
    return session.scalar(select(func.coalesce(func.max(OUTBOX.c.position), 0))) or 0


def oldest_position(session: Session) -> int:
    """Return the position of the oldest entry that is kept, 0 where there has been none."""
    return session.scalar(select(func.coalesce(func.min(OUTBOX.c.position), 0))) or 0


def entries_after(
    session: Session,
    position: int,
    *,
    types: Sequence[str] | None = None,
    satellite_id: str | None = None,
    caller: Caller | None = None,
    most: int = MOST_AT_ONCE,
) -> list[Entry]:
    """Return the entries behind ``position`` in their order, ``most`` of them: those that ``caller`` may see, if given.

    Call `place_new` first, so that what is new is among them.
    """
    wanted = select(OutboxEntry).where(OutboxEntry.position > position)
    if types is not None:
        wanted = wanted.where(OutboxEntry.type.in_([str(one) for one in types]))
    if satellite_id is not None:
        wanted = wanted.where(OutboxEntry.satellite_id == satellite_id)
    if caller is not None:
        wanted = wanted.where(_seen_by(caller))
    return [_entry(row) for row in session.scalars(wanted.order_by(OutboxEntry.position).limit(most))]


def forget_old(session: Session, keep_days: float) -> int:
    """Return how many entries have gone: those older than ``keep_days``.

    The newest stays, so that positions never begin anew.
    """
    before = utc_now() - timedelta(days=keep_days)
    gone = delete(OUTBOX).where(OUTBOX.c.at < before, OUTBOX.c.position < newest_position(session))
    return len(session.execute(gone.returning(OUTBOX.c.id)).all())


def _seen_by(caller: Caller) -> ColumnElement[bool]:
    if caller.satellites is None:
        return true()
    own = and_(OutboxEntry.satellite_id.is_(None), OutboxEntry.owner == caller.key_id)
    return or_(OutboxEntry.satellite_id.in_(sorted(caller.satellites)), own)


def _entry(row: OutboxEntry) -> Entry:
    event = Event(EventType(row.type), row.data, row.satellite_id, row.magnetometer_id, row.owner)
    return Entry(row.position or 0, row.event_id, row.at, event)
