"""Which database this is, and that its store and its data folder are its own.

A database has one row with its id. The store outside of it has a marker with the same id, and so has the data folder.
Where one of them is another's, or is empty where it should not be, nothing is written: an empty mount point, a mistyped
address, a replaced file or a fresh database after a failover would otherwise take telemetry, and a new admin key, as if
all were well.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from sqlalchemy import String, inspect, make_url, select, text
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.errors import UnavailableError
from app.settings import Settings
from app.storage.database import Base, Database, new_id, utc_now
from app.storage.store import Store, raw_key

MEMORY: Final = "magcal-database.json"
"""The data folder's marker."""
ADOPT: Final = "where this is meant, `magcal db adopt --apply` makes them belong together"


class ServiceIdentity(Base):
    """The one row that says which database this is, and where its objects are: ``database`` or ``outside``."""

    __tablename__ = "service_identity"

    database_id: Mapped[str] = mapped_column(String(32), primary_key=True)
    store: Mapped[str] = mapped_column(String(16))
    created_at: Mapped[datetime]


class WrongStoreError(UnavailableError):
    """Database, store and data folder do not belong together; nothing is written."""

    code = "wrong_store"


@dataclass(frozen=True, slots=True)
class Memory:
    """What the data folder remembers of its database; ``is_pending`` while that is being given its id."""

    database_id: str
    is_pending: bool


def place_of(settings: Settings) -> str:
    """Return where the database is, without its password."""
    return make_url(settings.url).render_as_string(hide_password=True)


def remembered(settings: Settings) -> Memory | None:
    """Return what the data folder remembers, None where it is new.

    Raises
    ------
    WrongStoreError
        The marker cannot be read.
    """
    path = settings.data_dir / MEMORY
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return Memory(str(found["database"]), bool(found.get("pending", False)))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WrongStoreError(f"{path} cannot be read: {error}") from error


def _remember(settings: Settings, memory: Memory) -> None:
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    path = settings.data_dir / MEMORY
    aside = path.with_suffix(".part")
    content = {"database": memory.database_id} | ({"pending": True} if memory.is_pending else {})
    with aside.open("w", encoding="utf-8") as file:
        file.write(json.dumps(content) + "\n")
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)
    folder = os.open(settings.data_dir, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def is_made(settings: Settings) -> bool:
    """Return whether there is a file of an SQLite database; of PostgreSQL its connection will tell."""
    name = None if settings.is_postgres else make_url(settings.url).database
    return name is None or name == ":memory:" or Path(name).exists()


def refuse_lost(settings: Settings) -> None:
    """Refuse to make a database in place of one that was there.

    Raises
    ------
    WrongStoreError
        The data folder had a database, and the one that the settings name is not there.
    """
    if is_made(settings):
        return
    memory = remembered(settings)
    if memory is not None and not memory.is_pending:
        gone = f"the database {memory.database_id} of {settings.data_dir} is gone"
        raise WrongStoreError(f"{gone}: there is no {make_url(settings.url).database}")


def require_database(settings: Settings) -> None:
    """Refuse a database that nobody has made yet.

    Raises
    ------
    WrongStoreError
        There is no file at the settings' place; PostgreSQL's schema is looked at later.
    """
    refuse_lost(settings)
    if not is_made(settings):
        name = make_url(settings.url).database
        raise WrongStoreError(f"there is no database {name}: `magcal serve` or `magcal db upgrade` makes one")


def refuse_empty(database: Database, store: Store, settings: Settings) -> None:
    """Refuse to fill an empty database whose data folder or store is another's.

    Raises
    ------
    WrongStoreError
        One of them belongs to a database already.
    """
    if inspect(database.engine).has_table("alembic_version"):
        return
    refuse_others(database, store, settings)


def found_identity(session: Session) -> ServiceIdentity | None:
    """Return which database this is, None where it was not told yet."""
    return session.scalar(select(ServiceIdentity))


def expect_own(database: Database, store: Store) -> str | None:
    """Return which database this is, and let this process write only while it and its store are what they are now.

    None where it was not set up yet.
    """
    if not inspect(database.engine).has_table(ServiceIdentity.__tablename__):
        return None
    with database.read() as session:
        row = found_identity(session)
    if row is None:
        return None
    database.expect(row.database_id)
    store.expect(row.database_id)
    return row.database_id


def require_own(database: Database, store: Store, settings: Settings) -> None:
    """Refuse a store or a data folder that is not the database's, for a command that makes neither.

    Raises
    ------
    WrongStoreError
        One of them is another's.
    """
    with database.read() as session:
        row = found_identity(session)
    if row is not None:
        check_identity(row, store, settings)
        database.expect(row.database_id)
        store.expect(row.database_id)
    else:
        refuse_others(database, store, settings)


def refuse_others(database: Database, store: Store, settings: Settings) -> None:
    """Refuse a data folder or a store of another database, for one that has no id yet.

    Raises
    ------
    WrongStoreError
        One of them belongs to a database already.
    """
    memory, marker = remembered(settings), store.marker()
    pending = memory.database_id if memory is not None and memory.is_pending else None
    for owner in (None if memory is None else memory.database_id, marker):
        if owner not in {None, pending}:
            raise WrongStoreError(
                f"the database {place_of(settings)} is new, but its data folder or store belongs to {owner}; {ADOPT}"
            )
    _require_bytes(database, store)


def settle_identity(database: Database, store: Store, settings: Settings) -> str:
    """Return the database's id, which it is given where it has none; its store and data folder are its own.

    The caller holds the lock that lets one process alone set a database up.

    Raises
    ------
    WrongStoreError
        The store or the data folder belongs to another database, or has lost its marker.
    """
    with database.read() as session:
        row = found_identity(session)
    if row is not None:
        check_identity(row, store, settings)
        if remembered(settings) is None:
            _remember(settings, Memory(row.database_id, is_pending=False))
        return row.database_id
    return _give_identity(database, store, settings)


def _give_identity(database: Database, store: Store, settings: Settings) -> str:
    """Return the new id of a database; a kill at any point leaves what the next try goes on from."""
    refuse_others(database, store, settings)
    memory = remembered(settings)
    database_id = memory.database_id if memory is not None else new_id()
    adopt(database, store, settings, database_id)
    return database_id


def adopt(database: Database, store: Store, settings: Settings, database_id: str) -> None:
    """Make database, store and data folder belong together, whatever they were before."""
    _remember(settings, Memory(database_id, is_pending=True))
    store.mark(database_id)
    with database.write() as session:
        row = found_identity(session)
        if row is None:
            row = ServiceIdentity(database_id=database_id, created_at=utc_now())
            session.add(row)
        row.store = "outside" if store.is_outside else "database"
    _remember(settings, Memory(database_id, is_pending=False))


def check_identity(row: ServiceIdentity, store: Store, settings: Settings) -> None:
    """Raise WrongStoreError where the store or the data folder is not that of the database."""
    memory = remembered(settings)
    if memory is not None and memory.database_id != row.database_id:
        raise WrongStoreError(
            f"{settings.data_dir} belongs to the database {memory.database_id}, "
            f"and {place_of(settings)} is {row.database_id}; {ADOPT}"
        )
    if (row.store == "outside") != store.is_outside:
        where = "outside of it: MAGCAL_STORE_URL must say where" if row.store == "outside" else "in it, not elsewhere"
        raise WrongStoreError(f"the database {row.database_id} keeps its objects {where}; {ADOPT}")
    check_marker(store, row.database_id)


def check_marker(store: Store, database_id: str) -> None:
    """Raise WrongStoreError where a store outside the database is not that of ``database_id``."""
    if not store.is_outside:
        return
    marker = store.marker()
    if marker != database_id:
        whose = "has no marker (is it mounted?)" if marker is None else f"belongs to the database {marker}"
        raise WrongStoreError(f"the store of the database {database_id} {whose}; {ADOPT}")


def _require_bytes(database: Database, store: Store) -> None:
    """Refuse a store without the newest telemetry of a database from before stores had markers."""
    newest = text(
        "SELECT session.satellite_id, chunk.sha256 FROM chunk JOIN session ON session.id = chunk.session_id "
        "WHERE session.raw_removed_at IS NULL ORDER BY chunk.created_at DESC LIMIT 1"
    )
    if not (store.is_outside and inspect(database.engine).has_table("chunk")):
        return
    with database.read() as session:
        row = session.execute(newest).first()
        if row is None:
            return
        key = raw_key(row.satellite_id, row.sha256)
        if not store.has(session, [key]):
            raise WrongStoreError(f"the store does not have {key}, the newest telemetry of the database; {ADOPT}")
