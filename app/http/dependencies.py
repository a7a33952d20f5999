"""What endpoints ask the application for: its database, settings and store.

Endpoints open their transactions themselves, inside their own thread: a dependency that held the database's writer
between two threads of the pool could wait for a thread that waits for the writer.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from app.http.services import HttpServices, services_of
from app.settings import Settings
from app.storage.database import Database
from app.storage.store import Store


async def _database(request: Request) -> Database:
    return services_of(request.app, HttpServices).database


async def _settings(request: Request) -> Settings:
    return services_of(request.app, HttpServices).settings


async def _store(request: Request) -> Store:
    return services_of(request.app, HttpServices).store


Db = Annotated[Database, Depends(_database)]
Config = Annotated[Settings, Depends(_settings)]
Blobs = Annotated[Store, Depends(_store)]
