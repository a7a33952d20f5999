"""Objects in the database: what is new costs no look at what was written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy import event, text
from sqlalchemy.engine import Engine

from app.settings import Settings
from app.storage.database import Base, Database
from app.storage.database_store import BLOB_PARTS, BLOBS, DatabaseStore
from app.storage.store import Packed, digest


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def database(request, tmp_path) -> Iterator[Database]:
    """A database with the tables of objects, of both kinds."""
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else None
    opened = Database(Settings(data_dir=tmp_path, **({} if url is None else {"database_url": url})))
    Base.metadata.create_all(opened.engine, [BLOBS, BLOB_PARTS])
    yield opened
    opened.close()


@contextmanager
def read_back(database) -> Iterator[list[str]]:
    """Yield the statements that read parts of objects."""
    asked: list[str] = []

    def note(connection, _cursor, statement, *_rest) -> None:
        if connection.engine.url == database.engine.url and "FROM blob_part" in statement:
            asked.append(statement)

    event.listen(Engine, "before_cursor_execute", note)
    try:
        yield asked
    finally:
        event.remove(Engine, "before_cursor_execute", note)


def packed(store: DatabaseStore, *contents: bytes) -> list[tuple[str, Packed]]:
    return [(f"a/{number}", store.pack(content, digest(content))) for number, content in enumerate(contents)]


def test_what_is_new_is_not_read_back_and_what_was_damaged_is_mended(database) -> None:
    store = DatabaseStore()
    objects = packed(store, b"one" * 1000, b"two" * 1000)
    with database.write() as session, read_back(database) as asked:
        store.put_all(session, objects)
    assert asked == []
    with database.write() as session:
        session.execute(text("UPDATE blob_part SET content = :c WHERE key = 'a/1'"), {"c": b"lost"})
    with database.write() as session, read_back(database) as asked:
        store.put_all(session, objects)
    assert asked
    with database.read() as session:
        for key, one in objects:
            assert store.get(session, key, one.sha256) == one.content
