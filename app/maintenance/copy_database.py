"""Move everything to another database, SQLite to PostgreSQL or back: nothing lost, nothing changed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from sqlalchemy import Column, RowMapping, Table, func, insert, select
from sqlalchemy.orm import Session

from app.errors import ConflictError
from app.jobs.tables import Job
from app.storage.database import Base, Database
from app.storage.migration import require_head

ROOMS: Final = (
    "app.access.audit_trail", "app.access.idempotency", "app.access.key_tables", "app.jobs.tables", "app.orbits.tables",
    "app.parameter_sets.tables", "app.satellites.tables", "app.sessions.tables", "app.storage.database_store",
)  # fmt: skip
"""Modules whose tables are the database."""
ROWS_AT_ONCE: Final = 200


def copy(source: Database, target: Database, *, progress: Callable[[str, int], None] | None = None) -> dict[str, int]:
    """Copy every row of ``source`` into ``target`` in one transaction and return how many rows each table has.

    Raises
    ------
    ConflictError
        A schema is not this version's, the target is not empty, or jobs are waiting or running in the source: their
        queue does not move with them.
    """
    for room in ROOMS:
        importlib.import_module(room)
    require_head(source)
    require_head(target)
    counts: dict[str, int] = {}
    with source.read() as old, target.write() as new:
        unfinished = old.scalar(select(func.count()).select_from(Job).where(Job.state.in_(("queued", "running"))))
        if unfinished:
            raise ConflictError(f"{unfinished} jobs wait or run: let the workers finish them, or cancel them, first")
        for table in Base.metadata.sorted_tables:
            if new.scalar(select(func.count()).select_from(table)):
                raise ConflictError(f"the target is not empty: table {table.name} has rows")
        for table in Base.metadata.sorted_tables:
            counts[table.name] = 0
            for rows in _parts(old, table):
                new.execute(insert(table), [dict(row) for row in rows])
                counts[table.name] += len(rows)
                if progress is not None:
                    progress(table.name, counts[table.name])
        for name, rows_copied in counts.items():
            found = new.scalar(select(func.count()).select_from(Base.metadata.tables[name]))
            if found != rows_copied:
                raise ConflictError(f"table {name}: {rows_copied} rows were sent, {found} arrived")
    return counts


def _parts(session: Session, table: Table) -> Iterator[Sequence[RowMapping]]:
    """Yield the rows of ``table`` in the order of their keys: what a row of the same table names comes before it."""
    keys: list[Column[object]] = list(table.primary_key.columns)
    found = session.execute(select(table).order_by(*keys).execution_options(yield_per=ROWS_AT_ONCE))
    yield from found.mappings().partitions(ROWS_AT_ONCE)
