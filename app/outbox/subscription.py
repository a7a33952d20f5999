"""Following the log from where one has come to: what a subscriber does with an entry, and how far it is, in one step.

    subscriber = Subscriber("attention", handle, types=[EventType.JOB_ENDED])
    while subscriber.take(database):        # until it has had all; again when there may be news
        ...

``handle(session, entry)`` is called for every entry in order, in the transaction that moves the subscriber's mark: what
it writes is there exactly once, over kills too. One process of a cluster should take at a time
(`app.storage.exclusive`); where two do, the mark's row lets one wait for the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from sqlalchemy import select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from app.outbox.events import Entry
from app.outbox.log import entries_after, newest_position, place_new
from app.outbox.tables import OutboxMark
from app.storage.database import Database

MOST_AT_ONCE: Final = 200


@dataclass(frozen=True, slots=True)
class Subscriber:
    """Who follows the log under ``name``; it begins with what happens after its first look, or with everything kept."""

    name: str
    handle: Callable[[Session, Entry], None]
    types: Sequence[str] | None = None
    from_the_start: bool = False

    def take(self, database: Database, most: int = MOST_AT_ONCE) -> int:
        """Return how many entries were new and have been handled, ``most`` at a time; on error, none of them."""
        place_new(database)
        with database.read() as session:
            mark = session.get(OutboxMark, self.name)
            if mark is not None and mark.position >= newest_position(session):
                return 0
        return database.transact(lambda session: self._handle(session, most))

    def _handle(self, session: Session, most: int) -> int:
        mark = self._mark(session)
        newest = newest_position(session)
        entries = entries_after(session, mark.position, types=self.types, most=most)
        for entry in entries:
            self.handle(session, entry)
        last = entries[-1].position if entries else 0
        mark.position = last if len(entries) == most else max(newest, mark.position, last)
        return len(entries)

    def _mark(self, session: Session) -> OutboxMark:
        """Return the subscriber's mark, locked, made where there is none."""
        place = select(OutboxMark).where(OutboxMark.name == self.name).with_for_update()
        found = session.scalar(place)
        if found is None:
            start = 0 if self.from_the_start else newest_position(session)
            make = postgresql.insert if session.get_bind().dialect.name == "postgresql" else sqlite.insert
            session.execute(make(OutboxMark).on_conflict_do_nothing(), [{"name": self.name, "position": start}])
            found = session.scalars(place).one()
        return found
