"""Messages to people through Apprise: one a cause, none in quiet hours, a digest where there are many."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

import structlog
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from app.errors import UnavailableError
from app.notifications.tables import Message
from app.outbox.events import Entry, EventType
from app.outbox.subscription import Subscriber
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now

FIRST_PAUSE_S: Final = 10.0
LONGEST_PAUSE_S: Final = 900.0
PATIENCE: Final = timedelta(hours=24)
MOST_IN_A_DIGEST: Final = 50
TOLD: Final = (EventType.ATTENTION_RAISED, EventType.ATTENTION_CLEARED, EventType.JOB_ENDED)

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Letter:
    """One message as it goes out, and the rows that it tells of."""

    title: str
    text: str
    ids: tuple[str, ...]


def letters(waiting: Sequence[Message], sent: int, per_hour: int) -> list[Letter]:
    """Return what goes out now of what is ``waiting``, where ``sent`` have gone within the hour.

    The last of an hour's messages is kept for a digest, so that ``per_hour`` is never exceeded and nothing is left out.
    """
    left = per_hour - sent
    if left <= 0 or not waiting:
        return []
    if len(waiting) == 1 or len(waiting) < left:
        return [Letter(one.title, one.text, (one.id,)) for one in waiting]
    shown = [f"{one.title}\n{one.text}" for one in waiting[:MOST_IN_A_DIGEST]]
    more = len(waiting) - len(shown)
    text = "\n\n".join([*shown, *([f"and {more} more"] if more else [])])
    return [Letter(f"magcal: {len(waiting)} messages", text, tuple(one.id for one in waiting))]


def is_quiet(hours: str | None, now: datetime) -> bool:
    """Return whether ``now``, UTC, is within quiet ``hours`` such as 22:00-06:00."""
    if hours is None:
        return False
    begin, _, end = hours.partition("-")
    clock = now.strftime("%H:%M")
    return begin <= clock < end if begin <= end else clock >= begin or clock < end


class Messenger:
    """Makes messages of what the log tells, and sends them.

    Raises
    ------
    UnavailableError
        Apprise is not installed, or does not know one of the URLs.
    """

    def __init__(self, database: Database, settings: Settings) -> None:
        if importlib.util.find_spec("apprise") is None:
            raise UnavailableError("MAGCAL_NOTIFY_URLS needs the package apprise: install magcal-service[notify]")
        from apprise import Apprise

        self._database = database
        self._settings = settings
        self._apprise = Apprise()
        for number, url in enumerate(settings.notify_urls.split()):
            if not self._apprise.add(url):
                raise UnavailableError(f"MAGCAL_NOTIFY_URLS: Apprise does not know the URL number {number + 1}")
        self._subscriber = Subscriber("messages", self._note, types=TOLD)

    def round(self) -> None:
        """Note what is new, and send what may go out now."""
        while self._subscriber.take(self._database):
            pass
        if is_quiet(self._settings.notify_quiet, utc_now()):
            return
        with self._database.read() as session:
            waiting = self._waiting(session)
            sent = self._sent(session)
        for letter in letters(waiting, sent, self._settings.notify_per_hour):
            self._settle(letter, is_sent=bool(self._apprise.notify(title=letter.title, body=letter.text)))

    def _note(self, session: Session, entry: Entry) -> None:
        """Make a message of an event that people are told of; what is over is told of no more, and may come again."""
        cause, data = _cause(entry), entry.event.data
        if entry.event.type is EventType.JOB_ENDED and data["state"] != "failed":
            if data["state"] == "succeeded":
                session.execute(delete(Message).where(Message.cause == cause))
            return
        if entry.event.type is EventType.ATTENTION_CLEARED:
            session.execute(delete(Message).where(Message.cause == cause))
            return
        if session.scalar(select(Message.id).where(Message.cause == cause)) is not None:
            return
        title, text = _words(entry, self._settings.public_url)
        now = utc_now()
        session.add(
            Message(id=new_id(), cause=cause, title=title, text=text, state="waiting", attempts=0,
                    next_attempt_at=now, created_at=now)
        )  # fmt: skip
        session.flush()

    def _waiting(self, session: Session) -> list[Message]:
        mine = select(Message).where(Message.state == "waiting", Message.next_attempt_at <= utc_now())
        return list(session.scalars(mine.order_by(Message.created_at, Message.id)))

    def _sent(self, session: Session) -> int:
        """Return how many messages, digests counted once, went out within the last hour."""
        since = utc_now() - timedelta(hours=1)
        return session.scalar(select(func.count(Message.sent_at.distinct())).where(Message.sent_at > since)) or 0

    def _settle(self, letter: Letter, *, is_sent: bool) -> None:
        self._database.transact(lambda session: _settle(session, letter, is_sent=is_sent))
        if not is_sent:
            log.warning("message_not_sent", title=letter.title)


def _settle(session: Session, letter: Letter, *, is_sent: bool) -> None:
    now = utc_now()
    for row in session.scalars(select(Message).where(Message.id.in_(letter.ids))):
        row.attempts += 1
        row.reason = None if is_sent else "Apprise could not send it; its log says why"
        if is_sent:
            row.state, row.sent_at = "sent", now
        elif now - row.created_at > PATIENCE:
            row.state = "parked"
        else:
            pause_s = min(FIRST_PAUSE_S * 2.0 ** min(row.attempts - 1, 20), LONGEST_PAUSE_S)
            row.next_attempt_at = now + timedelta(seconds=pause_s)


def _cause(entry: Entry) -> str:
    """Return what names the cause: the same event of the same magnetometer is told once."""
    event = entry.event
    what = f"job {event.data.get('kind')}" if event.type is EventType.JOB_ENDED else f"attention {event.data['cause']}"
    return f"{entry.lane} {what}"[:200]


def _words(entry: Entry, public_url: str | None) -> tuple[str, str]:
    """Return title and text: what, of which magnetometer, why, and where to look."""
    event = entry.event
    place = " ".join(filter(None, (event.satellite_id, event.magnetometer_id))) or "magcal"
    error = event.data.get("error")
    reason = str(event.data.get("reason") or (error.get("detail") if isinstance(error, dict) else "") or "")
    what = f"{event.data.get('kind')} failed" if event.type is EventType.JOB_ENDED else str(event.data["cause"])
    path = "/jobs" if event.type is EventType.JOB_ENDED else f"/satellites/{event.satellite_id or ''}"
    if event.satellite_id is None and event.type is not EventType.JOB_ENDED:
        path = "/"
    link = f"\n{public_url.rstrip('/')}{path}" if public_url else ""
    return f"{place}: {what}"[:200], f"{reason}{link}"
