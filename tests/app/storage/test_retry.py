"""What is tried again and what is not, on SQLite's own locks (F9), and what PostgreSQL ends (F2)."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError, OperationalError

from app.settings import Settings
from app.storage.database import Database
from app.storage.retry import AWAY, MOST_RETRIES, is_contention, outlasting, retried


@pytest.fixture
def database(tmp_path):
    opened = Database(Settings(data_dir=tmp_path))
    with opened.write() as session:
        session.execute(text("CREATE TABLE thing (id INTEGER PRIMARY KEY)"))
    yield opened
    opened.close()


def insert(database: Database, number: int) -> int:
    with database.write() as session:
        session.execute(text("INSERT INTO thing VALUES (:number)"), {"number": number})
    return number


@contextmanager
def held(database: Database, most_s: float = 60.0) -> Iterator[None]:
    """Hold the database's one writing lock from another connection, for ``most_s`` seconds at the most."""
    is_held, is_over = threading.Event(), threading.Event()

    def keep() -> None:
        other = sqlite3.connect(database.engine.url.database, isolation_level=None)
        other.execute("BEGIN EXCLUSIVE")
        is_held.set()
        is_over.wait(most_s)
        other.execute("ROLLBACK")
        other.close()

    thread = threading.Thread(target=keep)
    thread.start()
    assert is_held.wait(10)
    yield
    is_over.set()
    thread.join()


def test_a_lock_that_is_held_longer_than_sqlite_waits_is_waited_for_again(database):
    """SQLite gives up after 5 s; the lock is held for 6 s."""
    with held(database, 6.0):
        assert retried(lambda: insert(database, 1)) == 1


def test_a_lock_that_is_not_to_be_had_is_told_in_the_end_to_all_who_wait_for_it(database, monkeypatch):
    """None waits for ever behind the other's wait; reading goes on."""
    monkeypatch.setattr("app.storage.database.LONGEST_TURN_S", 2.0)
    with held(database), ThreadPoolExecutor(3) as pool:
        waiting = [pool.submit(retried, lambda number=number: insert(database, number)) for number in range(3)]
        time.sleep(0.5)
        with database.read() as session:
            assert session.scalar(text("SELECT count(*) FROM thing")) == 0
        errors = [one.exception() for one in waiting]
        assert all(isinstance(error, AWAY) for error in errors), errors
        assert any(is_contention(error) for error in errors)
    assert insert(database, 1) == 1


def test_a_conflict_is_tried_three_times_more_and_other_errors_not_at_all(database):
    insert(database, 1)
    tries = []

    def doubled() -> None:
        tries.append(1)
        insert(database, 1)

    with pytest.raises(Exception, match="UNIQUE"):
        retried(doubled)
    assert len(tries) == 1 + MOST_RETRIES

    def wrong() -> None:
        tries.append(1)
        with database.write() as session:
            session.execute(text("INSERT INTO nowhere VALUES (1)"))

    with pytest.raises(OperationalError, match="no such table") as caught:
        retried(wrong)
    assert not is_contention(caught.value)
    assert len(tries) == 2 + MOST_RETRIES


def test_patience_ends_when_it_is_told_to(database):
    def away() -> None:
        raise OperationalError("SELECT 1", {}, sqlite3.OperationalError("unable to open database file"))

    with pytest.raises(OperationalError):
        outlasting(away, 60.0, lambda _pause_s: True)


@pytest.mark.postgres
def test_what_is_paused_within_a_transaction_frees_its_rows(tmp_path, postgres_url):
    """F2: a worker's transaction that says nothing for its longest silence, 1 s here, is ended by PostgreSQL."""
    settings = Settings(data_dir=tmp_path, database_url=postgres_url)
    paused, other = Database(settings, longest_idle_s=1), Database(settings)
    with other.write() as session:
        session.execute(text("CREATE TABLE thing (id INTEGER PRIMARY KEY)"))
    assert insert(other, 1) == 1
    with pytest.raises(DBAPIError), paused.write() as session:
        session.execute(text("DELETE FROM thing WHERE id = 1"))
        with other.write() as next_one:
            assert next_one.execute(text("DELETE FROM thing WHERE id = 1")).rowcount == 1
    paused.close()
    other.close()
