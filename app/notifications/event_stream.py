"""HTTP of what happens: one stream of everything that the key may see."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Final

from fastapi import APIRouter, Depends, Header, Query, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import Field
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Reader, is_still_valid
from app.access.caller import Caller
from app.errors import ExpiredError
from app.http.dependencies import Db
from app.http.schemas import Filter, Slug
from app.http.services import HttpServices, services_of
from app.http.strict_json import StrictJsonRoute
from app.outbox.events import Entry, EventType
from app.outbox.log import entries_after, newest_position, oldest_position, place_new
from app.storage.database import Database
from magcal_core.errors import InputError

router = APIRouter(route_class=StrictJsonRoute, tags=["events"])

LOOK_EVERY_S: Final = 0.25
CHECK_KEY_EVERY_S: Final = 1.0
MOST_AT_ONCE: Final = 200
LATEST: Final = 1 << 62


class EventIdError(InputError):
    """A Last-Event-ID that this service did not give."""

    code = "event_id"


class EventQuery(Filter):
    """What to follow."""

    after: str | None = Field(None, max_length=20, description="As Last-Event-ID, for who cannot send headers.")
    type: list[EventType] | None = Field(None, description="Only these types.")
    satellite: Slug | None = Field(None, description="Only this satellite.")


class NewestEntry:
    """The position of the newest entry, asked of the database once for all streams of this process that want it."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._lock = asyncio.Lock()
        self._position, self._asked_s = 0, float("-inf")

    async def position(self) -> int:
        """Return it as the database had it `LOOK_EVERY_S` ago at the earliest."""
        async with self._lock:
            if time.monotonic() - self._asked_s >= LOOK_EVERY_S:
                self._position = await run_in_threadpool(self._look)
                self._asked_s = time.monotonic()
        return self._position

    def _look(self) -> int:
        place_new(self._database)
        with self._database.read() as session:
            return newest_position(session)


@dataclass(frozen=True, kw_only=True)
class EventServices(HttpServices):
    """What the stream of events adds to what the application holds."""

    newest_entry: NewestEntry


def _start(
    query: Annotated[EventQuery, Query()],
    _caller: Reader,
    db: Db,
    last_event_id: Annotated[str | None, Header(max_length=200)] = None,
) -> int:
    """Return the position behind which the stream begins: that of the last event seen, or that of the newest."""
    place_new(db)
    given = last_event_id if last_event_id is not None else query.after
    with db.read() as session:
        newest, oldest = newest_position(session), oldest_position(session)
    if given is None or not given.strip():
        return newest
    if not (given.isascii() and given.isdigit() and int(given) < LATEST):
        raise EventIdError("the id is not one of an event of this service")
    last = int(given)
    if last > newest:
        raise EventIdError(f"no event has this id yet; the newest is {newest}")
    if 0 < last < oldest - 1:
        raise ExpiredError(f"what followed that event is no longer kept; the oldest event is {oldest}")
    return last


@router.get("/events", response_class=EventSourceResponse)
async def follow_events(
    query: Annotated[EventQuery, Query()],
    start: Annotated[int, Depends(_start)],
    request: Request,
    caller: Reader,
    db: Db,
) -> AsyncIterator[ServerSentEvent]:
    """Follow what happens, from the event behind `Last-Event-ID` on, or from now; a revoked key sees no more."""
    held = services_of(request.app, EventServices)
    position, checked_s = start, time.monotonic()
    yield ServerSentEvent(id=str(start), comment="from here on")  # so that who loses the stream at once loses nothing
    while not held.stopping.is_asked():
        latest = await held.newest_entry.position()
        if latest > position or time.monotonic() - checked_s > CHECK_KEY_EVERY_S:
            if not await run_in_threadpool(is_still_valid, request):
                return
            checked_s = time.monotonic()
        while position < latest:
            entries = await run_in_threadpool(_entries, db, position, query, caller)
            for entry in entries:
                yield ServerSentEvent(data=entry.body, event=str(entry.event.type), id=str(entry.position))
            position = entries[-1].position if len(entries) == MOST_AT_ONCE else max(latest, position)
            position = max(position, entries[-1].position) if entries else position
        await asyncio.sleep(LOOK_EVERY_S)


def _entries(db: Database, position: int, query: EventQuery, caller: Caller) -> list[Entry]:
    with db.read() as session:
        return entries_after(
            session, position, types=query.type, satellite_id=query.satellite, caller=caller, most=MOST_AT_ONCE
        )
