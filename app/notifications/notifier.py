"""The threads that tell: one process of the installation at a time sends to webhooks and to people."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import structlog
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.notifications.delivering import SPREADER, Due, due, forget_old, is_anybody_told, settle
from app.notifications.hosts import AllowedHosts
from app.notifications.messages import Messenger
from app.notifications.sending import attempt
from app.outbox import log as outbox
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.exclusive import Exclusive

LOOK_EVERY_S: Final = 0.5
ASK_EVERY_S: Final = 2.0
"""A process that another one is ahead of asks so often whether it still is."""
AFTER_AN_ERROR_S: Final = 2.0
TIDY_EVERY_S: Final = 3600.0
SENDERS: Final = 8

log = structlog.get_logger()


class Notifier:
    """Sends what the log tells to webhooks, and messages to people, from start to stop."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self._database = database
        self._settings = settings
        self._allowed = AllowedHosts.of(settings.webhook_hosts)
        self._right = Exclusive(database, settings, "notifier")
        self._stopping = threading.Event()
        self._senders = ThreadPoolExecutor(SENDERS, "webhook")
        self._flying: dict[str, Due] = {}
        self._lock = threading.Lock()
        self._news = threading.Event()
        self._tidied_s = time.monotonic()
        self._messenger = Messenger(database, settings) if settings.notify_urls.strip() else None
        self._is_mine = threading.Event()
        self._threads = [threading.Thread(target=self._deliver, name="webhooks")]
        if self._messenger is not None:
            self._threads.append(threading.Thread(target=self._tell, args=(self._messenger,), name="messages"))

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Begin nothing new, let what is on its way end, and leave the rest to the next process."""
        self._stopping.set()
        self._news.set()
        for thread in self._threads:
            thread.join()
        self._senders.shutdown(wait=True)
        self._right.release()

    def _deliver(self) -> None:
        """Ask for the right again and again, and deliver while it is held."""
        while not self._stopping.is_set():
            self._guarded(self._ask)
            if self._is_mine.is_set():
                self._guarded(self._round)
                self._news.wait(LOOK_EVERY_S)
                self._news.clear()
            else:
                self._stopping.wait(ASK_EVERY_S)

    def _tell(self, messenger: Messenger) -> None:
        """Send messages to people while the right is held; a slow mail server holds no delivery up."""
        while not self._stopping.is_set():
            if self._is_mine.is_set():
                self._guarded(messenger.round)
            self._stopping.wait(LOOK_EVERY_S)

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except SQLAlchemyError as error:
            log.warning("notifier_waits", error=str(error))
            self._stopping.wait(AFTER_AN_ERROR_S)

    def _ask(self) -> None:
        if self._right.acquire():
            self._is_mine.set()
        else:
            self._is_mine.clear()

    def _round(self) -> None:
        """Make deliveries of what is new, and send what is due."""
        self._tidy()
        with self._database.read() as session:
            if not is_anybody_told(session):
                return
        while SPREADER.take(self._database):
            pass
        with self._lock:
            flying = list(self._flying.values())
        with self._database.read() as session:
            wanted = due(session, flying)
        for one in wanted:
            with self._lock:
                self._flying[one.delivery_id] = one
            self._senders.submit(self._send, one)

    def _send(self, one: Due) -> None:
        try:
            begun = utc_now()
            outcome = attempt(one.parcel, self._allowed, begun)
            hours = self._settings.webhook_retry_hours
            self._database.transact(lambda session: settle(session, one, outcome, begun, hours))
            if not outcome.is_delivered:
                log.info("webhook_not_delivered", webhook=one.webhook_id, attempt=one.attempts + 1, why=outcome.reason)
        except SQLAlchemyError as error:  # it is sent once more when the database is back: at least once
            log.warning("notifier_waits", error=str(error))
        finally:
            with self._lock:
                del self._flying[one.delivery_id]
            self._news.set()

    def _tidy(self) -> None:
        if time.monotonic() - self._tidied_s < TIDY_EVERY_S:
            return
        self._tidied_s = time.monotonic()
        self._database.transact(self._forget)

    def _forget(self, session: Session) -> None:
        outbox.forget_old(session, self._settings.event_days)
        forget_old(session, self._settings.event_days)
