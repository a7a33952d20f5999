"""Long transactions on SQLite: as durable as any, and brought home behind the commit."""

import os
import shutil
import sqlite3
from contextlib import closing

import pytest
from sqlalchemy import text

from app.settings import Settings
from app.storage.database import CHECKPOINT_PAGES, Database

MEBIBYTE = 1 << 20


@pytest.fixture
def database(tmp_path):
    opened = Database(Settings(data_dir=tmp_path / "data"))
    with opened.write() as session:
        session.execute(text("CREATE TABLE part (number INTEGER PRIMARY KEY, content BLOB)"))
    yield opened
    opened.close()


def add(session, number, size):
    session.execute(text("INSERT INTO part VALUES (:n, :c)"), {"n": number, "c": os.urandom(size)})


def numbers(path):
    with closing(sqlite3.connect(path)) as connection:
        return [row[0] for row in connection.execute("SELECT number FROM part ORDER BY number")]


def test_much_is_durable_in_the_log_before_it_is_home(database, tmp_path):
    """What the files say right after the commit, copied as a crash would leave them: the row, in log or file."""
    with database.write_much() as session:
        add(session, 1, 8 * MEBIBYTE)
    left = tmp_path / "left"
    shutil.copytree(tmp_path / "data", left)
    assert numbers(left / "magcal.db") == [1]


def test_much_is_brought_home_behind_the_commit(database, tmp_path):
    """Another connection keeps the log from being removed; the database file alone has every page all the same."""
    with closing(sqlite3.connect(tmp_path / "data" / "magcal.db")) as other:
        other.execute("SELECT count(*) FROM part").fetchall()
        with database.write_much() as session:
            add(session, 1, 8 * MEBIBYTE)
        database.close()
        home = tmp_path / "home.db"
        shutil.copy(tmp_path / "data" / "magcal.db", home)
    assert numbers(home) == [1]


def test_the_log_grows_no_longer_than_one_transaction_of_much(database, tmp_path):
    """Ten of 8 MiB, one behind the other: each begins the log anew; a page of 4096 bytes has 24 beside it there."""
    for number in range(10):
        with database.write_much() as session:
            add(session, number, 8 * MEBIBYTE)
    assert (tmp_path / "data" / "magcal.db-wal").stat().st_size < 1.1 * 8 * MEBIBYTE


def test_much_that_fails_leaves_nothing_and_the_next_writer_its_turn(database, tmp_path):
    with pytest.raises(ZeroDivisionError), database.write_much() as session:
        add(session, 1, MEBIBYTE)
        raise ZeroDivisionError
    with database.write() as session:
        add(session, 2, 100)
    assert numbers(tmp_path / "data" / "magcal.db") == [2]


def test_short_transactions_bring_the_log_home_themselves_again(database):
    """The connection that wrote much goes back to the pool as it was taken."""
    with database.write_much() as session:
        add(session, 1, MEBIBYTE)
    with database.write() as session:
        assert session.execute(text("PRAGMA wal_autocheckpoint")).scalar() == CHECKPOINT_PAGES
