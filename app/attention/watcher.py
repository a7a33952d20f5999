"""Follows the log of what happened: has sessions judged, and tells the log what needs attention and what is over.

One process of an installation at a time does it; the judging itself is a job, which any worker takes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Final

import structlog
from sqlalchemy import Row, delete, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.access.caller import SYSTEM
from app.attention.entries import Entry, Fleet
from app.attention.lives import tell_lives
from app.attention.tables import AttentionRaised
from app.jobs.kinds.monitoring import MonitoringBody
from app.jobs.queue import Queue
from app.jobs.repository import JobRepository
from app.outbox import log as outbox
from app.outbox.events import Entry as LogEntry
from app.outbox.events import Event, EventType, attention_changed
from app.outbox.subscription import Subscriber
from app.parameter_sets.repository import ParameterSetRepository
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.exclusive import Exclusive

LOOK_EVERY_S: Final = 0.25
ASK_EVERY_S: Final = 2.0
SWEEP_EVERY_S: Final = 15.0
"""What only time makes so is told at most so much late; the list itself is never late."""
REST: Final = 9.0
"""After a look at the whole fleet, news wait for so many times as long as it took: a tenth of one core at most."""
JUDGED_AT_ACTIVATION: Final = 20
"""Sessions, the newest of a magnetometer, that a newly activated set is held against."""
MONITORING_PRIORITY: Final = 10
TOLD: Final = (
    AttentionRaised.entry_id, AttentionRaised.satellite_id, AttentionRaised.magnetometer_id, AttentionRaised.code,
    AttentionRaised.severity,
)  # fmt: skip
Told = Row[str, str, str, str, str]
"""What the log has been told of."""
FOLLOWED: Final = (EventType.SESSION_RECEIVED, EventType.PARAMETER_SET_ACTIVATED)

log = structlog.get_logger()


class Watcher:
    """Keeps judgements and the log up to date, from start to stop."""

    def __init__(self, database: Database, settings: Settings, queue: Queue, fleet: Fleet) -> None:
        self._database = database
        self._queue = queue
        self._fleet = fleet
        self._right = Exclusive(database, settings, "attention")
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="attention")
        self._subscriber = Subscriber("attention", self._follow, types=FOLLOWED)
        self._swept_s = float("-inf")
        self._seen = -1
        self._rested_s = 0.0

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End with the round that is under way."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._right.release()

    def _watch(self) -> None:
        while not self._stopping.is_set():
            pause_s = ASK_EVERY_S
            try:
                if self._right.acquire():
                    self.round()
                    pause_s = LOOK_EVERY_S
            except SQLAlchemyError as error:
                log.warning("attention_waits", error=str(error))
            self._stopping.wait(pause_s)

    def round(self) -> None:
        """Follow what is new; where anything is, or time has passed, tell what needs attention now."""
        while self._subscriber.take(self._database):
            self._queue.announce()
        with self._database.read() as session:
            newest = outbox.newest_position(session)
        begun_s = time.monotonic()
        is_news = newest != self._seen and begun_s >= self._rested_s
        if not is_news and begun_s - self._swept_s < SWEEP_EVERY_S:
            return
        is_more = tell_lives(self._database, self._fleet)
        self._seen, self._swept_s = -1 if is_more else newest, begun_s
        tell_changes(self._database, self._fleet)
        self._rested_s = time.monotonic() + REST * (time.monotonic() - begun_s)

    def _follow(self, session: Session, entry: LogEntry) -> None:
        """Have judged what has arrived, or what a set that came into force is to be held against."""
        event = entry.event
        satellite_id, magnetometer_id = str(event.satellite_id), str(event.magnetometer_id)
        if ParameterSetRepository(session, SYSTEM).in_force(satellite_id, magnetometer_id) is None:
            return
        if event.type is EventType.SESSION_RECEIVED:
            wanted: Sequence[str] = [str(event.data["session_id"])] if event.data.get("samples") else []
        else:
            wanted = _newest_sessions(session, satellite_id, magnetometer_id)
        if wanted:
            body = MonitoringBody(kind="monitoring", session_ids=list(wanted), priority=MONITORING_PRIORITY)
            JobRepository(session, SYSTEM).submit(body, self._queue)


def _newest_sessions(session: Session, satellite_id: str, magnetometer_id: str) -> list[str]:
    row_of = TelemetrySession
    own = (row_of.satellite_id == satellite_id, row_of.magnetometer_id == magnetometer_id)
    usable = (row_of.data_until.is_not(None), row_of.state == "closed", row_of.raw_removed_at.is_(None))
    newest = select(row_of.id).where(*own, *usable).order_by(row_of.data_until.desc())
    return list(session.scalars(newest.limit(JUDGED_AT_ACTIVATION)))


def tell_changes(database: Database, fleet: Fleet) -> None:
    """Tell the log what needs attention and was not told of, and what was and is over."""
    with database.read() as session:
        found = {entry.id: entry for entry in fleet.view(session, SYSTEM).entries}
        told = {row.entry_id: row for row in session.execute(select(*TOLD))}
    raised = [entry for entry in found.values() if _is_news(entry, told.get(entry.id))]
    over = [row for entry_id, row in told.items() if entry_id not in found]
    if not raised and not over:
        return
    database.transact(lambda session: _tell(session, raised, over))


def _tell(session: Session, raised: Sequence[Entry], over: Sequence[Told]) -> None:
    gone = [row.entry_id for row in over] + [entry.id for entry in raised]
    for start in range(0, len(gone), 500):
        session.execute(delete(AttentionRaised).where(AttentionRaised.entry_id.in_(gone[start : start + 500])))
    session.add_all(_row(entry) for entry in raised)
    session.flush()
    cleared = (
        attention_changed(
            is_raised=False, cause=row.code, reason="over", satellite_id=row.satellite_id,
            magnetometer_id=row.magnetometer_id, details={"id": row.entry_id, "severity": row.severity},
        )
        for row in over
    )  # fmt: skip
    outbox.append(session, [*cleared, *(_event(entry) for entry in raised)])


def _is_news(entry: Entry, told: Told | None) -> bool:
    return told is None or (told.severity == "watch" and entry.finding.severity == "act")


def _row(entry: Entry) -> AttentionRaised:
    return AttentionRaised(
        entry_id=entry.id,
        satellite_id=entry.satellite_id,
        magnetometer_id=entry.magnetometer_id,
        code=entry.code,
        severity=str(entry.finding.severity),
        raised_at=utc_now(),
    )


def _event(entry: Entry) -> Event:
    details = {"id": entry.id, "severity": str(entry.finding.severity), "links": dict(entry.finding.links)}
    return attention_changed(
        is_raised=True,
        cause=entry.code,
        reason=entry.finding.text,
        satellite_id=entry.satellite_id,
        magnetometer_id=entry.magnetometer_id,
        details=details,
    )
