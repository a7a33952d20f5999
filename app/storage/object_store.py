"""Objects outside the database: in a folder, fsynced, or in a bucket through obstore.

An object is durable before the row that names it is committed; one without a row is what a crash between the two
leaves, and `magcal db audit` tells of it.
"""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import obstore
import obstore.store
import structlog
from sqlalchemy.orm import Session

from app.errors import StorageFullError, StoredObjectCorruptError, UnavailableError
from app.storage.store import Packed, verified

FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
FAILED: Final = (obstore.exceptions.BaseError, OSError)
"""What obstore raises: some of its errors are only Python's own, such as that of a bucket that is not there."""

log = structlog.get_logger()


class FileStore:
    """Objects as files: written aside, fsynced, renamed, the folder fsynced.

    After a failed fsync the kernel may have dropped what was written, so the store declares itself out of order
    rather than try again as if nothing had happened.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._broken: str | None = None
        folder.mkdir(parents=True, exist_ok=True)

    def pack(self, content: bytes, sha256: str) -> Packed:
        """Return ``content`` with its digest: it is kept as it is."""
        return Packed(content, sha256)

    def put(self, _session: Session, key: str, content: bytes | Packed) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        packed = Packed.of(content)
        self.check()
        path = self._folder / key
        aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with aside.open("wb") as file:
                file.write(packed.content)
                file.flush()
                os.fsync(file.fileno())
            aside.replace(path)
            self._sync_folders(path.parent)
        except OSError as error:
            aside.unlink(missing_ok=True)
            if error.errno in FULL:
                raise StorageFullError("there is no room in the store's folder") from error
            self._broken = error.strerror or "I/O error"
            log.exception("store_failed", key=key)
            raise UnavailableError("the store could not keep the object") from error
        return packed.sha256

    def put_all(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Keep each of ``objects`` under its key."""
        for key, one in objects:
            self.put(session, key, one)

    def _sync_folders(self, folder: Path) -> None:
        """Make the names of a new file and of new folders above it durable."""
        while True:
            number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(number)
            finally:
                os.close(number)
            if folder == self._folder:
                return
            folder = folder.parent

    def get(self, _session: Session, key: str, sha256: str) -> bytes:
        """Return the bytes under ``key``, verified."""
        try:
            content = (self._folder / key).read_bytes()
        except FileNotFoundError:
            raise StoredObjectCorruptError(f"the stored object {key} is gone") from None
        except OSError as error:
            raise UnavailableError("the store could not read the object") from error
        return verified(key, content, sha256)

    def delete(self, _session: Session, key: str) -> None:
        """Forget the object under ``key``, if there is one."""
        (self._folder / key).unlink(missing_ok=True)

    def keys(self, _session: Session) -> Iterator[str]:
        """Yield the key of every object."""
        for path in self._folder.rglob("*"):
            if path.is_file() and path.suffix != ".part":
                yield path.relative_to(self._folder).as_posix()

    def check(self) -> None:
        """Raise UnavailableError where the folder cannot be written, or a write has failed before."""
        if self._broken is not None:
            raise UnavailableError(f"the store failed and needs a restart: {self._broken}")
        if not os.access(self._folder, os.W_OK | os.X_OK):
            raise UnavailableError("the store's folder cannot be written")


class BucketStore:
    """Objects in a bucket; what it has acknowledged is durable."""

    def __init__(self, store: obstore.store.ObjectStore) -> None:
        self._store = store

    def pack(self, content: bytes, sha256: str) -> Packed:
        """Return ``content`` with its digest: it is kept as it is."""
        return Packed(content, sha256)

    def put(self, _session: Session, key: str, content: bytes | Packed) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        packed = Packed.of(content)
        try:
            obstore.put(self._store, key, packed.content)
        except FAILED as error:
            raise UnavailableError("the store could not keep the object") from error
        return packed.sha256

    def put_all(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Keep each of ``objects`` under its key."""
        for key, one in objects:
            self.put(session, key, one)

    def get(self, _session: Session, key: str, sha256: str) -> bytes:
        """Return the bytes under ``key``, verified."""
        try:
            content = bytes(obstore.get(self._store, key).bytes())
        except FileNotFoundError:
            raise StoredObjectCorruptError(f"the stored object {key} is gone") from None
        except FAILED as error:
            raise UnavailableError("the store could not read the object") from error
        return verified(key, content, sha256)

    def delete(self, _session: Session, key: str) -> None:
        """Forget the object under ``key``, if there is one."""
        try:
            obstore.delete(self._store, key)
        except FileNotFoundError:
            return
        except FAILED as error:
            raise UnavailableError("the store could not remove the object") from error

    def keys(self, _session: Session) -> Iterator[str]:
        """Yield the key of every object."""
        for part in obstore.list(self._store):
            yield from (str(entry["path"]) for entry in part)

    def check(self) -> None:
        """Raise UnavailableError where the bucket does not answer."""
        try:
            next(iter(obstore.list(self._store, chunk_size=1)), None)
        except FAILED as error:
            raise UnavailableError("the store does not answer") from error
