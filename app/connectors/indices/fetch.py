"""Fetch an index from where it is published, with the manners that its publishers ask for.

A file is asked for once in `MAGCAL_INDEX_EVERY_H` hours, whatever is restarted or killed meanwhile: it is written down
before it is sent. One that is final is kept and not asked for again. Any answer but 200 stops the source until a
person starts it again. One process at a time asks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta

import structlog

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM
from app.connectors.errors import SourceAnswerError, SourceContentError, SourceUnreachableError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.indices.contract import IndexPart
from app.connectors.indices.registry import INDEX_SOURCES
from app.connectors.tables import ConnectorMark, ConnectorStop
from app.indices.repository import IndexRepository
from app.outbox.events import attention_changed
from app.outbox.log import append
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.exclusive import Exclusive
from magcal_core.errors import MagcalError
from magcal_core.field.index import Index
from magcal_core.field.index_files import read_index

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Fetched:
    """What became of one file: ``new``, ``known``, ``final``, ``not yet``, or ``failed`` and why."""

    part: str
    state: str
    why: str | None = None


class IndexFetch:
    """One source of an index."""

    def __init__(self, database: Database, settings: Settings, name: str) -> None:
        self._database = database
        self._settings = settings
        self._name = name
        self._source = INDEX_SOURCES[name]

    @property
    def stop_name(self) -> str:
        """The source's name where it says that it is stopped."""
        return f"index-{self._name}"

    def stopped(self) -> str | None:
        """Return why the source must not be asked, None where it may."""
        with self._database.read() as session:
            row = session.get(ConnectorStop, self.stop_name)
            return None if row is None else row.reason

    def start_again(self) -> bool:
        """Let the source be asked again; return whether it had been stopped."""
        with self._database.write() as session:
            row = session.get(ConnectorStop, self.stop_name)
            if row is None:
                return False
            session.delete(row)
            record_event(session, SYSTEM, "index_source.start", self._name)
            cause = f"index source {self._name} stopped"
            append(session, [attention_changed(is_raised=False, cause=cause, reason="started again by a person")])
        return True

    def run(self, since: datetime) -> Iterator[Fetched]:
        """Yield what became of each file from ``since`` on; nothing where another process asks or it is stopped."""
        right = Exclusive(self._database, self._settings, self.stop_name)
        if not right.acquire():
            return
        try:
            now = utc_now()
            for part in self._source.parts(self._settings, since, now):
                if self.stopped() is not None:
                    return
                yield self._one(part, now)
        finally:
            right.release()

    def _one(self, part: IndexPart, now: datetime) -> Fetched:
        mark = f"index {self._name} {part.name}"
        with self._database.write() as session:
            row = session.get(ConnectorMark, mark)
            if row is not None and row.mark == "kept" and part.final_at is not None and row.updated_at >= part.final_at:
                return Fetched(part.name, "final")
            if row is not None and now < row.updated_at + timedelta(hours=self._settings.index_every_h):
                return Fetched(part.name, "not yet")
            session.merge(ConnectorMark(name=mark, mark="asked", updated_at=now))
        try:
            content = self._asked(part)
            index = self._read(content)
        except SourceAnswerError as error:
            self._stop(error.message)
            return Fetched(part.name, "failed", error.message)
        except (SourceUnreachableError, SourceContentError) as error:
            return Fetched(part.name, "failed", error.message)
        except MagcalError as error:
            return Fetched(part.name, "failed", f"what it answered cannot be read: {error.code}: {error.message}")
        with self._database.write() as session:
            _, is_new = IndexRepository(session, SYSTEM).add_index(content, index)
            session.merge(ConnectorMark(name=mark, mark="kept", updated_at=now))
        return Fetched(part.name, "new" if is_new else "known")

    def _asked(self, part: IndexPart) -> bytes:
        client = SourceClient(part.url)
        try:
            return require_no_page(client.get(part.url))
        finally:
            client.close()

    def _read(self, content: bytes) -> Index:
        index = read_index(content)
        if index.name != self._source.index_name:
            raise SourceContentError(f"it answered with the index {index.name}, not with {self._source.index_name}")
        return index

    def _stop(self, reason: str) -> None:
        why = f"{reason}; it is not asked again until you say so: magcal indices start {self._name}"
        with self._database.write() as session:
            session.merge(ConnectorStop(source=self.stop_name, reason=why[:500], stopped_at=utc_now()))
            record_event(session, SYSTEM, "index_source.stop", self._name)
            cause = f"index source {self._name} stopped"
            append(session, [attention_changed(is_raised=True, cause=cause, reason=why)])
        log.error("index_source_stopped", source=self._name, why=reason)
