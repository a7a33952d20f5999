"""Objects leave the store after the transaction that gave them up, and only while no row names them.

A crash between the two leaves a row that says what is still to be removed; the next removal does it.
"""

from __future__ import annotations

from functools import partial
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.maintenance.object_names import Naming, naming_of
from app.storage.database import Database
from app.storage.database_store import ObjectToRemove, keep_after_all
from app.storage.object_locks import take_objects
from app.storage.retry import retried
from app.storage.store import Store

MOST_AT_ONCE: Final = 100
"""Objects of one transaction, during which no upload of their satellite goes on."""


def remove_objects(database: Database, store: Store) -> int:
    """Return how many objects that nobody needs any more have left the store."""
    removed = 0
    while True:
        with database.read() as session:
            first = session.scalar(select(ObjectToRemove.satellite_id).order_by(ObjectToRemove.key).limit(1))
        if first is None:
            return removed
        removed += retried(partial(_remove_some, database, store, first))


def _remove_some(database: Database, store: Store, satellite_id: str) -> int:
    with database.write() as session:
        take_objects(session, satellite_id)
        own = select(ObjectToRemove.key).where(ObjectToRemove.satellite_id == satellite_id)
        keys = session.scalars(own.order_by(ObjectToRemove.key).limit(MOST_AT_ONCE)).all()
        removed = [key for key in keys if _remove(session, store, key)]
        keep_after_all(session, keys)
    return len(removed)


def _remove(session: Session, store: Store, key: str) -> bool:
    """Return whether an object has been removed: where a row needs it again, it stays."""
    if naming_of(session, key).naming is Naming.NEEDED:
        return False
    store.delete(session, key)
    return True
