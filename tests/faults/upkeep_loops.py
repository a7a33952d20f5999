"""What an operator's process does over and over until it is killed: each begins by saying that it is at work."""

from __future__ import annotations

import itertools
from multiprocessing.connection import Connection

import app.jobs.kinds.registry  # noqa: F401  every table that a row may name
from app.access.caller import SYSTEM
from app.errors import ConflictError
from app.maintenance.rebuild import rebuild
from app.parameter_sets.repository import ParameterSetRepository
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import head, migrate
from app.storage.open_store import open_store


def activate(settings: Settings, sets: list[str], at_work: Connection) -> None:
    """Put one set after the other in force, and take every third activation back."""
    database = Database(settings)
    for number in itertools.count():
        with database.write() as session:
            sets_of = ParameterSetRepository(session, SYSTEM)
            sets_of.activate(sets[number % len(sets)], force=False)
        if number % 3 == 0:
            try:
                with database.write() as session:
                    ParameterSetRepository(session, SYSTEM).rollback(sets[number % len(sets)])
            except ConflictError:
                pass
        if number == 0:
            at_work.send(True)


def rebuild_all(settings: Settings, columns: list[str], at_work: Connection) -> None:
    """Lose the columnar forms, and make them again."""
    database, store = Database(settings), open_store(settings)
    for number in itertools.count():
        with database.write() as session:
            for key in columns:
                store.delete(session, key)
        if number == 0:
            at_work.send(True)
        rebuild(database, store, settings)


def move_schema(settings: Settings, _nothing: list[str], at_work: Connection) -> None:
    """Move the schema down by one revision and up again."""
    database = Database(settings)
    at_work.send(True)
    while True:
        migrate(database, "0011_indices")
        migrate(database, head())
