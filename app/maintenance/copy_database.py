"""Move everything to another database, SQLite to PostgreSQL or back: nothing lost, nothing changed."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sqlalchemy import Column, RowMapping, Table, func, insert, select
from sqlalchemy.exc import DataError, IntegrityError
from sqlalchemy.orm import Session

from app.errors import ConflictError
from app.jobs.tables import Job
from app.outbox.tables import OutboxEntry
from app.storage.database import Base, Database
from app.storage.migration import require_head

ROOMS: Final = (
    "app.aboard.tables", "app.access.audit_trail", "app.access.idempotency", "app.access.key_tables",
    "app.attention.tables", "app.connectors.tables", "app.indices.tables", "app.jobs.tables", "app.notes.tables",
    "app.notifications.tables", "app.orbits.tables", "app.outbox.tables", "app.parameter_sets.tables",
    "app.satellites.tables", "app.sessions.tables", "app.storage.database_store", "app.storage.identity",
)  # fmt: skip
"""Modules whose tables are the database."""
ROWS_AT_ONCE: Final = 200
UNFIT: Final = (DataError, IntegrityError, UnicodeEncodeError)
"""What a database raises where a value is too long for it, cannot be text in it, or names a row that is not there."""


@dataclass(frozen=True, slots=True)
class Copied:
    """How many rows of each table arrived, and which were left out, and why."""

    counts: dict[str, int]
    skipped: tuple[str, ...]


def copy(
    source: Database,
    target: Database,
    *,
    may_skip: bool = False,
    progress: Callable[[str, int], None] | None = None,
) -> Copied:
    """Copy every row of ``source`` into ``target`` in one transaction and return how many rows each table has.

    With ``may_skip``, a row that the target does not take is left out, and those that name it with it.

    Raises
    ------
    ConflictError
        A schema is not this version's, the target is not empty, a row does not fit into it, or jobs are waiting or
        running in the source: their queue does not move with them.
    """
    for room in ROOMS:
        importlib.import_module(room)
    require_head(source)
    require_head(target)
    counts: dict[str, int] = {}
    skipped: list[str] = []
    with source.read() as old, target.write() as new:
        if not source.is_sqlite:  # one snapshot for all of it, as SQLite gives by itself
            old.connection(execution_options={"isolation_level": "REPEATABLE READ"})
        _refuse_unready(old, new)
        for table in Base.metadata.sorted_tables:
            counts[table.name] = 0
            for rows in _parts(old, table):
                left_out = _send(new, table, [dict(row) for row in rows], may_skip=may_skip)
                skipped.extend(left_out)
                counts[table.name] += len(rows) - len(left_out)
                if progress is not None:
                    progress(table.name, counts[table.name])
        _count_on(new)
        for name, rows_copied in counts.items():
            found = new.scalar(select(func.count()).select_from(Base.metadata.tables[name]))
            if found != rows_copied:
                raise ConflictError(f"table {name}: {rows_copied} rows were sent, {found} arrived")
    return Copied(counts, tuple(skipped))


def _refuse_unready(old: Session, new: Session) -> None:
    unfinished = old.scalar(select(func.count()).select_from(Job).where(Job.state.in_(("queued", "running"))))
    if unfinished:
        raise ConflictError(f"{unfinished} jobs wait or run: let the workers finish them, or cancel them, first")
    for table in Base.metadata.sorted_tables:
        if new.scalar(select(func.count()).select_from(table)):
            raise ConflictError(f"the target is not empty: table {table.name} has rows")


def _send(new: Session, table: Table, rows: Sequence[dict[str, object]], *, may_skip: bool) -> list[str]:
    """Return which of ``rows`` the target did not take; without ``may_skip``, raise with the name of the first."""
    try:
        with new.begin_nested():
            new.execute(insert(table), rows)
    except UNFIT:
        skipped = [told for row in rows if (told := _send_one(new, table, row)) is not None]
        if skipped and not may_skip:
            raise ConflictError(f"a row does not fit: {skipped[0]}; --skip leaves it out") from None
        return skipped
    return []


def _send_one(new: Session, table: Table, row: dict[str, object]) -> str | None:
    """Return the name of a row and why the target does not take it, None where it does."""
    try:
        with new.begin_nested():
            new.execute(insert(table), [row])
    except UNFIT as error:
        key = ", ".join(f"{column.name}={row[column.name]!r}" for column in table.primary_key.columns)
        why = str(getattr(error, "orig", None) or error).splitlines()[0]
        return f"{table.name} ({key}): {why}"
    return None


def _count_on(session: Session) -> None:
    """Let the numbers that PostgreSQL gives to entries of the log go on behind those that were copied."""
    if session.get_bind().dialect.name == "postgresql":
        following = select(func.coalesce(func.max(OutboxEntry.id), 0) + 1).scalar_subquery()
        session.execute(select(func.setval(func.pg_get_serial_sequence("outbox", "id"), following, False)))


def _parts(session: Session, table: Table) -> Iterator[Sequence[RowMapping]]:
    """Yield the rows of ``table`` in the order of their keys: what a row of the same table names comes before it."""
    keys: list[Column[object]] = list(table.primary_key.columns)
    found = session.execute(select(table).order_by(*keys).execution_options(yield_per=ROWS_AT_ONCE))
    yield from found.mappings().partitions(ROWS_AT_ONCE)
