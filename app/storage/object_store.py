"""Objects outside the database: in a folder, fsynced, or in a bucket through obstore.

An object is durable before the row that names it is committed; one without a row is what a crash between the two
leaves, and `magcal db audit` tells of it.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import time
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

MARKER: Final = "magcal-store.json"
"""Key of what says to which database a store belongs."""
LOOK_AGAIN_S: Final = 10.0
"""A bucket's marker is looked at again before a put, where the last look is older."""

log = structlog.get_logger()


class FileStore:
    """Objects as files: written aside, fsynced, renamed, the folder fsynced.

    After a failed fsync the kernel may have dropped what was written, so the store declares itself out of order
    rather than try again as if nothing had happened.
    """

    is_outside = True

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._broken: str | None = None
        self._owner: str | None = None

    def marker(self) -> str | None:
        """Return the id of the database that the folder belongs to, None where it has no marker."""
        try:
            return _owner_in((self._folder / MARKER).read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise UnavailableError("the store's marker cannot be read") from error

    def mark(self, database_id: str) -> None:
        """Make the folder, which is made where there is none, belong to a database."""
        self._write(MARKER, _marker_of(database_id))

    def expect(self, database_id: str) -> None:
        """Keep and check from now on only while the folder belongs to a database."""
        self._owner = database_id

    def pack(self, content: bytes, sha256: str) -> Packed:
        """Return ``content`` with its digest: it is kept as it is."""
        return Packed(content, sha256)

    def put(self, _session: Session, key: str, content: bytes | Packed) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        packed = Packed.of(content)
        self.check()
        self._write(key, packed.content)
        return packed.sha256

    def _write(self, key: str, content: bytes) -> None:
        path = self._folder / key
        aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with aside.open("wb") as file:
                file.write(content)
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

    def put_all(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Keep each of ``objects`` under its key."""
        for key, one in objects:
            self.put(session, key, one)

    def replace(self, session: Session, key: str, content: Packed) -> None:
        """Keep ``content`` under ``key``, whatever lies there."""
        self.put(session, key, content)

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

    def has(self, _session: Session, keys: Sequence[str]) -> set[str]:
        """Return which of ``keys`` have an object, without reading it."""
        return {key for key in keys if (self._folder / key).is_file()}

    def delete(self, _session: Session, key: str) -> None:
        """Forget the object under ``key``, if there is one."""
        (self._folder / key).unlink(missing_ok=True)

    def keys(self, _session: Session) -> Iterator[str]:
        """Yield the key of every object."""
        for path in self._folder.rglob("*"):
            key = path.relative_to(self._folder).as_posix()
            if key != MARKER and path.suffix != ".part" and path.is_file():
                yield key

    def check(self) -> None:
        """Raise UnavailableError where the folder is not the database's, cannot be written, or a write has failed."""
        if self._broken is not None:
            raise UnavailableError(f"the store failed and needs a restart: {self._broken}")
        if self._owner is None:
            self._folder.mkdir(parents=True, exist_ok=True)
        elif self.marker() != self._owner:
            raise UnavailableError(f"the store's folder is not that of the database {self._owner}: is it mounted?")
        if not os.access(self._folder, os.W_OK | os.X_OK):
            raise UnavailableError("the store's folder cannot be written")


class BucketStore:
    """Objects in a bucket; what it has acknowledged, and says that it has when it is asked, is durable.

    ``is_outside`` is false of one in memory, which ends with its process and so belongs to nobody.
    """

    def __init__(self, store: obstore.store.ObjectStore, *, is_outside: bool = True) -> None:
        self._store = store
        self.is_outside = is_outside
        self._owner: str | None = None
        self._looked_s = 0.0

    def marker(self) -> str | None:
        """Return the id of the database that the bucket belongs to, None where it has no marker."""
        if not self.is_outside:
            return None
        try:
            return _owner_in(bytes(obstore.get(self._store, MARKER).bytes()))
        except FileNotFoundError:
            return None
        except FAILED as error:
            raise UnavailableError("the store does not answer") from error

    def mark(self, database_id: str) -> None:
        """Make the bucket belong to a database."""
        if not self.is_outside:
            return
        try:
            obstore.put(self._store, MARKER, _marker_of(database_id))
        except FAILED as error:
            raise UnavailableError("the store's marker cannot be written") from error

    def expect(self, database_id: str) -> None:
        """Keep and check from now on only while the bucket belongs to a database."""
        self._owner = database_id if self.is_outside else None

    def pack(self, content: bytes, sha256: str) -> Packed:
        """Return ``content`` with its digest: it is kept as it is."""
        return Packed(content, sha256)

    def put(self, _session: Session, key: str, content: bytes | Packed) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        packed = Packed.of(content)
        if time.monotonic() - self._looked_s > LOOK_AGAIN_S:
            self._check_owner()
        try:
            obstore.put(self._store, key, packed.content)
            kept = obstore.head(self._store, key)["size"]
        except FAILED as error:
            raise UnavailableError("the store could not keep the object") from error
        if kept != len(packed.content):
            raise UnavailableError("the store has not kept the whole object")
        return packed.sha256

    def put_all(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Keep each of ``objects`` under its key."""
        for key, one in objects:
            self.put(session, key, one)

    def replace(self, session: Session, key: str, content: Packed) -> None:
        """Keep ``content`` under ``key``, whatever lies there."""
        self.put(session, key, content)

    def has(self, _session: Session, keys: Sequence[str]) -> set[str]:
        """Return which of ``keys`` have an object, without reading it."""
        return {key for key in keys if self._has(key)}

    def _has(self, key: str) -> bool:
        try:
            obstore.head(self._store, key)
        except FileNotFoundError:
            return False
        except FAILED as error:
            raise UnavailableError("the store does not answer") from error
        return True

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
        try:
            for part in obstore.list(self._store):
                yield from (str(entry["path"]) for entry in part if entry["path"] != MARKER)
        except FAILED as error:
            raise UnavailableError("the store does not answer") from error

    def check(self) -> None:
        """Raise UnavailableError where the bucket does not answer, or is not the database's."""
        self._check_owner()
        try:
            next(iter(obstore.list(self._store, chunk_size=1)), None)
        except FAILED as error:
            raise UnavailableError("the store does not answer") from error

    def _check_owner(self) -> None:
        if self._owner is not None and self.marker() != self._owner:
            raise UnavailableError(f"the store's bucket is not that of the database {self._owner}")
        self._looked_s = time.monotonic()


def _marker_of(database_id: str) -> bytes:
    return json.dumps({"database": database_id}).encode() + b"\n"


def _owner_in(marker: bytes) -> str:
    """Return the id of the database in a marker.

    Raises
    ------
    UnavailableError
        It is not a marker as `_marker_of` makes it.
    """
    try:
        return str(json.loads(marker)["database"])
    except (ValueError, KeyError, TypeError) as error:
        raise UnavailableError("the store's marker cannot be read") from error
