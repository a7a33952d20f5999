"""What endpoints ask the application for: its database, settings, store and queue.

Endpoints open their transactions themselves, inside their own thread: a dependency that held the database's writer
between two threads of the pool could wait for a thread that waits for the writer.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from app.settings import Settings
from app.storage.database import Database
from app.storage.store import Store


async def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


async def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _store(request: Request) -> Store:
    store: Store = request.app.state.store
    return store


Db = Annotated[Database, Depends(_database)]
Config = Annotated[Settings, Depends(_settings)]
Blobs = Annotated[Store, Depends(_store)]
