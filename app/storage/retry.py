"""What is worth another try: a transaction that lost against others, and a database that was away for a moment."""

from __future__ import annotations

import asyncio
import sqlite3
import time
from collections.abc import Awaitable, Callable, Iterator
from random import SystemRandom
from typing import Final, TypeVar

import structlog
from sqlalchemy.exc import DBAPIError, IntegrityError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

MOST_RETRIES: Final = 3
LONGEST_S: Final = 10.0
"""No further try is begun so long after the first: whoever waits is told to come back instead."""
FIRST_PAUSE_S: Final = 0.05
CONTENTION: Final = frozenset({"40001", "40P01", "55P03", "23505", "23503"})
"""PostgreSQL: serialization failure, deadlock, lock not had in time, a row that two made at once, and one that another
removed while this transaction named it."""
SQLITE_CONTENTION: Final = (
    "SQLITE_BUSY",
    "SQLITE_LOCKED",
    "SQLITE_CONSTRAINT_UNIQUE",
    "SQLITE_CONSTRAINT_PRIMARYKEY",
    "SQLITE_CONSTRAINT_FOREIGNKEY",
)
DAMAGED: Final = ("SQLITE_CORRUPT", "SQLITE_NOTADB")
"""How SQLite tells of a file that is damaged, or none of its own."""
AWAY: Final = (OperationalError, InterfaceError, PoolTimeoutError)
"""What SQLAlchemy raises where a database cannot be reached or does not answer in time."""

Result = TypeVar("Result")
log = structlog.get_logger()


def is_contention(error: BaseException) -> bool:
    """Return whether a transaction lost against another one, so that it may succeed when it is tried again."""
    if not isinstance(error, OperationalError | IntegrityError):
        return False
    if isinstance(error.orig, sqlite3.Error):
        return (getattr(error.orig, "sqlite_errorname", None) or "").startswith(SQLITE_CONTENTION)
    return getattr(error.orig, "sqlstate", None) in CONTENTION


def _pauses_s() -> Iterator[float]:
    """Yield the pause before each retry, s: jittered, longer each time, none where it would be too late."""
    begun = time.monotonic()
    for number in range(MOST_RETRIES):
        if time.monotonic() - begun > LONGEST_S:
            return
        yield FIRST_PAUSE_S * 2**number * SystemRandom().uniform(0.5, 1.5)


def retried(work: Callable[[], Result]) -> Result:
    """Return what ``work`` returns, which is tried again while its transaction loses against others."""
    pauses_s = _pauses_s()
    while True:
        try:
            return work()
        except DBAPIError as error:
            pause_s = next(pauses_s, None)
            if pause_s is None or not is_contention(error):
                raise
            log.info("retried", error=str(error.orig), pause_s=round(pause_s, 3))
            time.sleep(pause_s)


async def retried_async(work: Callable[[], Awaitable[Result]], may_repeat: Callable[[], bool]) -> Result:
    """Return what ``work`` returns, as `retried` does, as long as ``may_repeat`` says that it can be repeated."""
    pauses_s = _pauses_s()
    while True:
        try:
            return await work()
        except DBAPIError as error:
            pause_s = next(pauses_s, None)
            if pause_s is None or not is_contention(error) or not may_repeat():
                raise
            log.info("retried", error=str(error.orig), pause_s=round(pause_s, 3))
            await asyncio.sleep(pause_s)


def outlasting(work: Callable[[], Result], patience_s: float, is_over: Callable[[float], bool]) -> Result:
    """Return what ``work`` returns, tried again while the database is away, for ``patience_s`` seconds.

    ``is_over`` waits for so many seconds between two tries, and ends the patience by returning True.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            return retried(work)
        except AWAY as error:
            if time.monotonic() > deadline or is_over(1.0):
                raise
            log.warning("database_away", error=str(error))
