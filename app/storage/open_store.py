"""The store that the settings name: the database, a folder or a bucket."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote, urlsplit

import obstore.store

from app.settings import Settings
from app.storage.database_store import DatabaseStore
from app.storage.object_store import BucketStore, FileStore
from app.storage.store import Store
from magcal_core.errors import OptionError


def open_url(url: str) -> FileStore | BucketStore:
    """Return the store at ``url``: a folder (``file:///...``) or a bucket (``s3://...`` or what else obstore knows).

    Raises
    ------
    OptionError
        The folder's address is not that of a folder of this machine, from its root on.
    """
    parts = urlsplit(url)
    if parts.scheme in {"", "file"}:
        folder = Path(unquote(parts.path))
        if parts.netloc not in {"", "localhost"} or not folder.is_absolute():
            raise OptionError("MAGCAL_STORE_URL names a folder, but not from the root on: want file:///srv/magcal")
        return FileStore(folder)
    if parts.scheme == "memory":
        return BucketStore(obstore.store.MemoryStore(), is_outside=False)
    try:
        return BucketStore(obstore.store.from_url(url))
    except (obstore.exceptions.BaseError, ValueError) as error:
        raise OptionError(f"MAGCAL_STORE_URL names no store that is known: {error}") from error


def open_store(settings: Settings) -> Store:
    """Return the store that the settings name."""
    if settings.store_url is None:
        return DatabaseStore()

    return open_url(settings.store_url)
