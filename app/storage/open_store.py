"""The store that the settings name: the database, a folder or a bucket."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

import obstore.store

from app.settings import Settings
from app.storage.database_store import DatabaseStore
from app.storage.object_store import BucketStore, FileStore
from app.storage.store import Store


def open_url(url: str) -> FileStore | BucketStore:
    """Return the store at ``url``: a folder (``file:///...``) or a bucket (``s3://...`` or what else obstore knows)."""
    parts = urlsplit(url)
    if parts.scheme in {"", "file"}:
        return FileStore(Path(unquote(parts.path)))
    if parts.scheme == "memory":
        return BucketStore(obstore.store.MemoryStore())
    return BucketStore(obstore.store.from_url(url))


def open_store(settings: Settings) -> Store:
    """Return the store that the settings name."""
    if settings.store_url is None:
        return DatabaseStore()

    return open_url(settings.store_url)
