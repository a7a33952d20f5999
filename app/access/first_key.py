"""The administrator's key that the first start on an empty database makes."""

from __future__ import annotations

from app.access.caller import Scope
from app.access.key_repository import KeyRepository
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import _alone


def make_first_key(database: Database, settings: Settings) -> str | None:
    """Return a new admin key where the database has never had one, None where it has."""
    with _alone(database, settings), database.write() as session:
        keys = KeyRepository(session)
        return keys.create([Scope.ADMIN], name="first").key if keys.is_empty() else None
