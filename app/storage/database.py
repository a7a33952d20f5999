"""The database: engines, transactions, and the column types that both databases share."""

from __future__ import annotations

import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, TypeVar

from sqlalchemy import (
    JSON,
    ColumnElement,
    Connection,
    DateTime,
    Dialect,
    Engine,
    MetaData,
    create_engine,
    event,
    make_url,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.engine.interfaces import DBAPIConnection, ExceptionContext
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import DeclarativeBase, Session
from sqlalchemy.pool import ConnectionPoolEntry
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.visitors import InternalTraversal
from sqlalchemy.types import TypeDecorator

from app.settings import Settings
from app.storage.retry import DAMAGED, retried

Result = TypeVar("Result")
WRITES: Final = "magcal_writes"
POOL_SIZE: Final = 32
LONGEST_TURN_S: Final = 15.0
"""A writer of a process that has not had its turn for so long gives up; threads must not pile up behind a lock."""
CHECKPOINT_PAGES: Final = 1000
"""Length of the write-ahead log at which a transaction brings it home itself; SQLite's own value."""
UNSYNCED: Final = frozenset({"SQLITE_IOERR_FSYNC", "SQLITE_IOERR_DIR_FSYNC"})
"""How SQLite tells of a sync that failed; PostgreSQL ends its server then, and recovers."""
LONGEST_LOOK_S: Final = 0.5
"""So long a look for damage may take; a database that takes longer is looked at as far as that."""
POSTGRES_OPTIONS: Final = (
    "-c timezone=UTC -c synchronous_commit=on -c statement_timeout=60000 -c lock_timeout=5000 "
    "-c idle_in_transaction_session_timeout={idle_ms}"
)
LONGEST_IDLE_S: Final = 120
"""PostgreSQL ends a transaction in which nothing was said for so long: a long body may be on its way into a bucket."""


class UtcDateTime(TypeDecorator[datetime]):
    """A zone-aware time in UTC on both databases; SQLite keeps it without its zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    @property
    def python_type(self) -> type[datetime]:
        """What Python sees of it."""
        return datetime

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return what goes to the driver."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("a time without a zone")
        in_utc = value.astimezone(UTC)
        return in_utc.replace(tzinfo=None) if dialect.name == "sqlite" else in_utc

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return what came from the driver, in UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of every table; constraints have names, so that migrations can alter them."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {datetime: UtcDateTime()}  # noqa: RUF012


JsonColumn: Final = JSON(none_as_null=True).with_variant(JSONB(none_as_null=True), "postgresql")


class DatabaseNow(ColumnElement[datetime]):
    """The database's clock, moved by ``offset_s``; leases are told by it, never by a worker's clock."""

    _traverse_internals = [("offset_s", InternalTraversal.dp_plain_obj)]  # noqa: RUF012  part of a statement's cache key
    type = UtcDateTime()

    def __init__(self, offset_s: float = 0.0) -> None:
        self.offset_s = float(offset_s)


@compiles(DatabaseNow, "sqlite")
def _now_sqlite(element: DatabaseNow, compiler: SQLCompiler, **_kw: object) -> str:
    return f"strftime('%Y-%m-%d %H:%M:%f000', 'now', '{element.offset_s:+.3f} seconds')"


@compiles(DatabaseNow, "postgresql")
def _now_postgres(element: DatabaseNow, compiler: SQLCompiler, **_kw: object) -> str:
    return f"(clock_timestamp() + make_interval(secs => {element.offset_s:.3f}))"


class Database:
    """One engine for reading and one for writing over the same pool.

    On SQLite a writing transaction begins with ``BEGIN IMMEDIATE`` and the writers of a process queue for one lock,
    so that they wait in line rather than in SQLite's polling. After a failed sync the kernel may have dropped what was
    written, so the process writes no more, rather than sync again as if nothing had happened. On PostgreSQL a process
    that is paused within a transaction keeps its rows for ``longest_idle_s`` at most.
    """

    def __init__(self, settings: Settings, *, longest_idle_s: int = LONGEST_IDLE_S) -> None:
        self.is_sqlite = not settings.is_postgres
        self.engine = _sqlite_engine(settings) if self.is_sqlite else _postgres_engine(settings, longest_idle_s)
        self._write_engine = self.engine.execution_options(**{WRITES: True})
        self._writer = threading.Lock()
        self._name = make_url(settings.url).database or ":memory:"
        self._watcher = _watcher_of(self._name) if self.is_sqlite else None
        self._bringer = ThreadPoolExecutor(1, "checkpoint")
        self._brought: Future[None] | None = None
        self._failure: OperationalError | None = None
        self._expected: tuple[str, tuple[int, int] | None] | None = None
        self._looked_at: tuple[int, int, int] | None = None
        if self.is_sqlite:
            event.listen(self.engine, "handle_error", self._note)
        else:
            event.listen(self.engine, "connect", self._check_identity)

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Yield a session that only reads."""
        with Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Yield a session whose one transaction is committed at the end, or rolled back by an error."""
        turn = self._turn() if self.is_sqlite else nullcontext()
        with turn, Session(self._write_engine, expire_on_commit=False) as session, session.begin():
            yield session

    def transact(self, work: Callable[[Session], Result]) -> Result:
        """Return what ``work`` returns from a transaction of its own, tried again while that loses against others.

        For whatever writes beside requests, whose routes try again themselves. On SQLite another process may have the
        lock for longer than a connection waits for it, or take it again and again: its writers poll, and do not queue.
        """

        def attempt() -> Result:
            with self.write() as session:
                return work(session)

        return retried(attempt)

    @contextmanager
    def write_much(self) -> Iterator[Session]:
        """Yield a session as `write` does, for a transaction of many megabytes.

        Its pages are durable in the write-ahead log once it is committed; on SQLite they are brought home from there
        behind it, where a short transaction does that itself now and then. The next one waits until they are, lest
        the log grow without end.
        """
        if not self.is_sqlite:
            with self.write() as session:
                yield session
            return
        with self._turn(), self._write_engine.connect() as connection:
            if self._brought is not None:
                wait([self._brought])
                self.check()
            driver = connection.connection.cursor()
            driver.execute("PRAGMA wal_autocheckpoint=0")
            try:
                with Session(connection, expire_on_commit=False) as session, session.begin():
                    yield session
            finally:
                driver.execute(f"PRAGMA wal_autocheckpoint={CHECKPOINT_PAGES}")
                driver.close()
            self._brought = self._bringer.submit(self._bring_home)

    def _bring_home(self) -> None:
        """Copy what is in the write-ahead log into the database file, as far as no reader needs it where it is.

        Where another connection is at it already, or it fails, what is left is the next transaction's, unless a sync
        failed.
        """
        try:
            with closing(sqlite3.connect(self._name, timeout=0.0, isolation_level=None)) as connection:
                connection.execute("PRAGMA synchronous=FULL")
                connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        except sqlite3.OperationalError as error:
            self._note_unsynced(OperationalError("PRAGMA wal_checkpoint", None, error))

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if not self._writer.acquire(timeout=LONGEST_TURN_S):
            raise PoolTimeoutError(f"no turn to write within {LONGEST_TURN_S:g} s")
        try:
            self.check()
            yield
        finally:
            self._writer.release()

    def expect(self, database_id: str) -> None:
        """Write from now on only to the database that is there now, which is known as ``database_id``.

        SQLite's is told by its file, which may be replaced or removed under this process; PostgreSQL's by its row of
        identity, on every new connection: behind its address may stand another server.
        """
        self._expected = database_id, self._file() if self.is_sqlite else None

    def _file(self) -> tuple[int, int] | None:
        """Return what tells the database's file from another one of its name; None where there is none."""
        try:
            found = Path(self._name).stat()
        except OSError:
            return None
        return found.st_dev, found.st_ino

    def _check_identity(self, connection: DBAPIConnection, _entry: ConnectionPoolEntry) -> None:
        """Refuse a new connection of PostgreSQL that leads to another database than is expected."""
        if self._expected is None:
            return
        cursor = connection.cursor()
        cursor.execute("SELECT to_regclass('service_identity')")
        found = cursor.fetchone()
        if found is not None and found[0] is not None:
            cursor.execute("SELECT database_id FROM service_identity")
            found = cursor.fetchone()
        cursor.close()
        connection.rollback()
        if found is None or found[0] != self._expected[0]:
            raise psycopg_error(f"the database is not {self._expected[0]}, which this process began with")

    def _note(self, context: ExceptionContext) -> None:
        error = context.sqlalchemy_exception
        if isinstance(error, OperationalError):
            self._note_unsynced(error)
        elif isinstance(error, DatabaseError) and getattr(error.orig, "sqlite_errorname", "").startswith(DAMAGED):
            self._failure = OperationalError("the database file is damaged", None, error.orig)  # type: ignore[arg-type]

    def _note_unsynced(self, error: OperationalError) -> None:
        if getattr(error.orig, "sqlite_errorname", None) in UNSYNCED:
            self._failure = error

    def check(self) -> None:
        """Raise OperationalError where this process must not write any more.

        A sync has failed in it, and it must be started anew; or the database is damaged, or another file has taken its
        place.
        """
        if self.is_sqlite and self._expected is not None and self._file() != self._expected[1]:
            gone = sqlite3.OperationalError(f"the database file {self._name} was removed or replaced")
            raise OperationalError("the database is gone", None, gone)
        if self._failure is not None and self._failure.orig is not None:
            raise OperationalError("a sync failed before", None, self._failure.orig)

    def look_for_damage(self) -> None:
        """Raise OperationalError where the file of an SQLite database is damaged, as far as a short look shows.

        The look is SQLite's own quick check over a connection of its own, which has nothing of the file in memory; a
        file that has not changed since the last look is not looked at again.
        """
        if not self.is_sqlite or self._name == ":memory:":
            return
        try:
            seen = Path(self._name).stat()
        except FileNotFoundError as error:
            gone = sqlite3.OperationalError(str(error))
            raise OperationalError("the database file is gone", None, gone) from error
        state = seen.st_ino, seen.st_size, seen.st_mtime_ns
        if state != self._looked_at:
            why = _damage(self._name)
            if why is not None:
                damaged = sqlite3.DatabaseError(why)
                raise OperationalError("the database file is damaged", None, damaged)
            self._looked_at = state

    def revision(self) -> int | None:
        """Return a number that any process's next commit changes; None on PostgreSQL, which has none at hand."""
        if self._watcher is None:
            return None
        try:
            return int(self._watcher.execute("PRAGMA data_version").fetchone()[0])
        except sqlite3.Error:
            return None

    def close(self) -> None:
        """Close every connection of the pool, once what was written is brought home."""
        self._bringer.shutdown()
        self.engine.dispose()
        if self._watcher is not None:
            self._watcher.close()


def psycopg_error(message: str) -> Exception:
    """Return the error by which the driver of PostgreSQL tells that a database is out of reach."""
    import psycopg

    return psycopg.OperationalError(message)


def _postgres_engine(settings: Settings, longest_idle_s: int) -> Engine:
    options = POSTGRES_OPTIONS.format(idle_ms=1000 * longest_idle_s)
    return create_engine(
        settings.url,
        pool_pre_ping=True,
        pool_size=POOL_SIZE,
        max_overflow=POOL_SIZE,
        pool_timeout=5,
        connect_args={"options": options, "connect_timeout": 5, "application_name": "magcal"},
    )


def _sqlite_engine(settings: Settings) -> Engine:
    name = make_url(settings.url).database
    if name and name != ":memory:":
        settings.data_dir.mkdir(parents=True, exist_ok=True)
    engine = create_engine(
        settings.url, pool_size=POOL_SIZE, max_overflow=POOL_SIZE, connect_args={"check_same_thread": False}
    )
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _damage(name: str) -> str | None:
    """Return what a short look finds wrong with a database file, None where it finds nothing."""
    until = time.monotonic() + LONGEST_LOOK_S
    try:
        with closing(sqlite3.connect(f"{Path(name).as_uri()}?mode=ro", uri=True, timeout=0.0)) as connection:
            connection.set_progress_handler(lambda: int(time.monotonic() > until), 1000)
            found = connection.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.OperationalError:
        return None  # no time left for more of it, or a writer is at work
    except sqlite3.DatabaseError as error:
        return str(error)
    return None if found is None or found[0] == "ok" else str(found[0])


def _watcher_of(name: str) -> sqlite3.Connection:
    """Return a connection that never writes, so that every commit is another's to it."""
    return sqlite3.connect(name, timeout=0.0, check_same_thread=False, isolation_level=None)


def _prepare_sqlite(connection: DBAPIConnection, _entry: ConnectionPoolEntry) -> None:
    connection.isolation_level = None  # the driver must not begin transactions of its own
    cursor = connection.cursor()
    for pragma in ("busy_timeout=5000", "journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_sqlite(connection: Connection) -> None:
    writes = connection.get_execution_options().get(WRITES, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def new_id() -> str:
    """Return a new identifier, 32 hexadecimal digits (UUID version 7), later ones sorting behind earlier ones."""
    stamp_ms = time.time_ns() // 1_000_000
    noise = int.from_bytes(os.urandom(10))
    value = (stamp_ms & (1 << 48) - 1) << 80 | noise
    value = value & ~(0xF << 76) | 7 << 76
    value = value & ~(0x3 << 62) | 0x2 << 62
    return f"{value:032x}"


def id_before(id_: str, most_ms: int) -> str:
    """Return an id that is before all that `new_id` made since ``most_ms`` before ``id_``; "" is before all."""
    return "" if not id_ else f"{max(int(id_[:12], 16) - most_ms, 0):012x}"


def utc_now() -> datetime:
    """Return this machine's time, for records; leases use the database's."""
    return datetime.now(UTC)
