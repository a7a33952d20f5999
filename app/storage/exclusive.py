"""One process of an installation at a time: a lock that ends with its holder, however that ends.

On PostgreSQL it is an advisory lock of a connection of its own, on SQLite, whose processes share a machine, a lock of a
file in the data folder. Neither needs a clock, and neither writes anything while nothing happens.
"""

from __future__ import annotations

import fcntl
import hashlib
from typing import IO

from sqlalchemy import Connection, text
from sqlalchemy.exc import DBAPIError

from app.settings import Settings
from app.storage.database import Database


class Exclusive:
    """The right to do what ``name`` stands for, alone in the whole installation."""

    def __init__(self, database: Database, settings: Settings, name: str) -> None:
        self._database = database
        self._settings = settings
        self._name = name
        self._number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], signed=True)
        self._file: IO[str] | None = None
        self._connection: Connection | None = None

    def acquire(self) -> bool:
        """Return whether this process has the right now; it keeps it until `release`, or until it ends.

        Asked again by its holder, it says whether the right still is its own: a connection may have been cut.
        """
        return self._by_file() if self._database.is_sqlite else self._by_connection()

    def release(self) -> None:
        """Leave the right to others."""
        if self._file is not None:
            self._file.close()
            self._file = None
        if self._connection is not None:
            self._connection.invalidate()  # closed, not given back to the pool: the lock ends with it
            self._connection.close()
            self._connection = None

    def _by_file(self) -> bool:
        if self._file is not None:
            return True
        self._settings.data_dir.mkdir(parents=True, exist_ok=True)
        opened = (self._settings.data_dir / f".{self._name}.lock").open("w")
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            opened.close()
            return False
        self._file = opened
        return True

    def _by_connection(self) -> bool:
        try:
            if self._connection is not None:
                self._connection.execute(text("SELECT 1"))
                return True
            engine = self._database.engine.execution_options(isolation_level="AUTOCOMMIT")
            self._connection = engine.connect()
            asked = text("SELECT pg_try_advisory_lock(:number)")
            if self._connection.execute(asked, {"number": self._number}).scalar():
                return True
        except DBAPIError:
            self.release()
            return False
        self.release()
        return False
