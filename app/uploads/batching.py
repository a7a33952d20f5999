"""Who does the steps of an upload: a few threads read long ones, one reads short ones and writes all of them.

However many stations send at once, no more threads than processors compete to read, and uploads that wait together
are read one after the other and then share one transaction. None is acknowledged before its transaction is durable.
"""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import structlog
from sqlalchemy.exc import DBAPIError

from app.storage.database import Database
from app.storage.retry import AWAY, retried
from app.uploads.ingest import Asked, Ingest, Kept, Prepared
from magcal_core.errors import MagcalError

READERS: Final = max(2, os.cpu_count() or 1)
SMALL_BYTES: Final = 1 << 17
"""Bodies up to this size are read by the thread that writes: long ones do not hold them up, nor they each other."""
MOST_TOGETHER: Final = 32
MUCH_BYTES: Final = 4 << 20
"""Body beyond which a transaction leaves it to another thread to bring its pages home."""
MOST_BYTES_TOGETHER: Final = 16 << 20
"""Body beyond which no further upload joins a transaction."""

log = structlog.get_logger()


@dataclass(slots=True, eq=False)
class _Waiting:
    """An upload that waits for its transaction, and what has become of it."""

    prepared: Prepared
    kept: Kept | None = None
    failed: Exception | None = None
    is_taken: bool = False
    is_left: bool = False


class Keeper:
    """Reads uploads and makes them durable."""

    def __init__(self, ingest: Ingest, database: Database) -> None:
        self._ingest = ingest
        self._database = database
        self._readers = ThreadPoolExecutor(READERS, "read")
        self._writer = ThreadPoolExecutor(1, "keep")
        self._waiting: deque[_Waiting] = deque()

    async def keep(self, asked: Asked) -> Kept:
        """Return the session of an upload, durable; the same bytes and the same key give the same session."""
        loop = asyncio.get_running_loop()
        # Behind those that wait to be read already: so they are all read before the first of them is written.
        reader = self._writer if len(asked.upload.content) <= SMALL_BYTES else self._readers
        prepared = await loop.run_in_executor(reader, self._ingest.prepare, asked)
        if isinstance(prepared, Kept):
            return prepared
        mine = _Waiting(prepared)
        self._waiting.append(mine)
        try:
            kept = await loop.run_in_executor(self._writer, self._written, mine)
        finally:
            mine.is_left = True
        self._ingest.tell(prepared, kept)
        return kept

    def close(self) -> None:
        """Let what has been begun end."""
        for threads in (self._readers, self._writer):
            threads.shutdown()

    def _written(self, mine: _Waiting) -> Kept:
        """Return what became of ``mine``: kept with those before it, or else now with those that wait behind it.

        Where one of them cannot be kept, each is left to a transaction of its own.
        """
        if not mine.is_taken:
            batch = self._take()
            try:
                self._write(batch)
            except AWAY as error:
                for one in batch:
                    one.failed = error
            except (MagcalError, DBAPIError) as error:
                log.info("uploads_parted", uploads=len(batch), error=str(error))
        if mine.failed is not None:
            raise mine.failed
        return mine.kept or self._write([mine])[0]

    def _take(self) -> list[_Waiting]:
        """Return the uploads that are to share a transaction, the first that waits among them."""
        batch: list[_Waiting] = []
        size = 0
        while self._waiting and len(batch) < MOST_TOGETHER and size < MOST_BYTES_TOGETHER:
            one = self._waiting.popleft()
            one.is_taken = True
            if not one.is_left:
                batch.append(one)
                size += one.prepared.size_bytes
        return sorted(batch, key=lambda one: one.prepared.asked.order)

    def _write(self, batch: Sequence[_Waiting]) -> list[Kept]:
        kept = retried(lambda: self._transaction(batch))
        for one, its in zip(batch, kept, strict=True):
            one.kept = its
        return kept

    def _transaction(self, batch: Sequence[_Waiting]) -> list[Kept]:
        is_much = sum(one.prepared.size_bytes for one in batch) > MUCH_BYTES
        with self._database.write_much() if is_much else self._database.write() as session:
            return self._ingest.write(session, [one.prepared for one in batch])
