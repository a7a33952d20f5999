"""The store that the settings name: the database, a folder or a bucket."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

import obstore.store

from app.settings import Settings
from app.storage.database_store import DatabaseStore
from app.storage.object_store import BucketStore, FileStore
from app.storage.store import Store
from magcal_core.errors import OptionError

if TYPE_CHECKING:
    from obstore.store import RetryConfig

RETRIES: Final[RetryConfig] = {"max_retries": 3, "retry_timeout": timedelta(seconds=10)}
"""How often a bucket that fails is asked again: a transaction waits for it, and obstore's own 3 min are too long.

One answer may take 30 s, which is obstore's own limit; options of its client given here would hide those of the
environment."""


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
        return BucketStore(obstore.store.from_url(url, retry_config=RETRIES))
    except (obstore.exceptions.BaseError, ValueError) as error:
        raise OptionError(f"MAGCAL_STORE_URL names no store that is known: {error}") from error


def open_store(settings: Settings) -> Store:
    """Return the store that the settings name."""
    if settings.store_url is None:
        return DatabaseStore()

    return open_url(settings.store_url)
