"""Where raw bytes and derived chunks lie: in the database by default, or in a folder or bucket.

An object is named by its key and known by the SHA-256 of its bytes, which every read verifies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from typing import Final

import zstandard
from sqlalchemy import BigInteger, ForeignKey, LargeBinary, String, delete, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.errors import StoredObjectCorruptError
from app.storage.database import Base, utc_now
from app.storage.store import Packed, Store, digest, verified

PART_BYTES: Final = 1 << 22
ZSTD: Final = zstandard.ZstdCompressionParameters.from_level(1, hash_log=10, min_match=6)
"""A table of places that the nearest cache holds: of rows of numbers it finds what a large one does, and sooner."""
ZSTD_FRAMING: Final = -1000
"""Level at which zstd does little but copy, for bytes that are compressed already."""
PROBE_BYTES: Final = 1 << 16
SHRUNK: Final = 0.95


class Blob(Base):
    """One stored object; its bytes are in its parts."""

    __tablename__ = "blob"

    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64))
    size_bytes: Mapped[int] = mapped_column(BigInteger)


class BlobPart(Base):
    """A part of an object's bytes, compressed with zstd."""

    __tablename__ = "blob_part"

    key: Mapped[str] = mapped_column(ForeignKey("blob.key", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    content: Mapped[bytes] = mapped_column(LargeBinary)


class ObjectToRemove(Base):
    """An object that no row names any more, and that is to be removed once the transaction that said so is durable."""

    __tablename__ = "object_to_remove"

    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    satellite_id: Mapped[str] = mapped_column(String(63), index=True)
    created_at: Mapped[datetime]


BLOBS: Final = Blob.metadata.tables["blob"]
BLOB_PARTS: Final = Blob.metadata.tables["blob_part"]
"""Without the mapper, which doubles the time that an upload holds the writer's turn."""
INSERTS: Final = (("sqlite", sqlite.insert), ("postgresql", postgresql.insert))
NEW_BLOB: Final = {
    name: insert(BLOBS).on_conflict_do_nothing().execution_options(preserve_rowcount=True) for name, insert in INSERTS
}
"""Says how many it made: SQLAlchemy forgets that otherwise, and whatever is new would be read back and verified."""
NEW_PART: Final = {name: insert(BLOB_PARTS).on_conflict_do_nothing() for name, insert in INSERTS}
"""Equal bytes have equal parts: what is there already stays as it is, where it is whole."""
TO_REMOVE: Final = ObjectToRemove.metadata.tables["object_to_remove"]
NEW_TO_REMOVE: Final = {name: insert(TO_REMOVE).on_conflict_do_nothing() for name, insert in INSERTS}


def is_whole(store: Store, session: Session, key: str, sha256: str) -> bool:
    """Return whether the bytes under ``key`` are there and have the digest ``sha256``; they are read for that."""
    try:
        store.get(session, key, sha256)
    except StoredObjectCorruptError:
        return False
    return True


def remove_later(session: Session, satellite_id: str, keys: Iterable[str]) -> None:
    """Note that objects of a satellite are to be removed, in the transaction after which no row names them."""
    now = utc_now()
    rows = [{"key": key, "satellite_id": satellite_id, "created_at": now} for key in sorted(set(keys))]
    if rows:
        session.execute(NEW_TO_REMOVE[session.get_bind().dialect.name], rows)


def keep_after_all(session: Session, keys: Sequence[str]) -> None:
    """Take back that objects are to be removed: a row names them again."""
    session.execute(delete(TO_REMOVE).where(TO_REMOVE.c.key.in_(keys)))


class DatabaseStore:
    """Objects in the database, in the transaction of the rows that name them."""

    is_outside = False

    def marker(self) -> str | None:
        """Return None: the store is the database itself."""
        return None

    def mark(self, database_id: str) -> None:
        """Nothing to mark: the store is the database itself."""

    def expect(self, database_id: str) -> None:
        """Nothing to expect: the store is the database itself."""

    def pack(self, content: bytes, sha256: str) -> Packed:
        """Return ``content`` with its parts, compressed."""
        view = memoryview(content)
        starts = range(0, len(content), PART_BYTES)
        return Packed(content, sha256, tuple(_compressed(view[start : start + PART_BYTES]) for start in starts))

    def put(self, session: Session, key: str, content: bytes | Packed) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        packed = content if isinstance(content, Packed) else self.pack(content, digest(content))
        self.put_all(session, [(key, packed)])
        return packed.sha256

    def put_all(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Keep each of ``objects`` under its key, by one statement for all."""
        connection = session.connection()
        rows = [{"key": key, "sha256": one.sha256, "size_bytes": len(one.content)} for key, one in objects]
        parts = [
            {"key": key, "number": number, "content": part}
            for key, one in objects
            for number, part in enumerate(one.parts)
        ]
        if not rows:
            return
        made = connection.execute(NEW_BLOB[connection.dialect.name], rows)
        if parts:
            connection.execute(NEW_PART[connection.dialect.name], parts)
        if made.rowcount != len(rows):
            self._mend(session, objects)

    def _mend(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Replace those of ``objects`` that were there already and are not whole."""
        for key, one in objects:
            if not is_whole(self, session, key, one.sha256):
                self.replace(session, key, one)

    def replace(self, session: Session, key: str, content: Packed) -> None:
        """Keep ``content`` under ``key``, whatever lies there."""
        self.delete(session, key)
        self.put_all(session, [(key, content)])

    def get(self, session: Session, key: str, sha256: str) -> bytes:
        """Return the bytes under ``key``, verified."""
        parts = session.scalars(select(BlobPart.content).where(BlobPart.key == key).order_by(BlobPart.number))
        unpack = zstandard.ZstdDecompressor().decompress
        try:
            content = b"".join(unpack(part, max_output_size=PART_BYTES) for part in parts)
        except zstandard.ZstdError as error:
            raise StoredObjectCorruptError(f"the stored object {key} cannot be decompressed") from error
        return verified(key, content, sha256)

    def has(self, session: Session, keys: Sequence[str]) -> set[str]:
        """Return which of ``keys`` have an object, without reading it."""
        with_parts = select(BlobPart.key).where(BlobPart.key.in_(keys), BlobPart.number == 0)
        return set(session.scalars(with_parts))

    def delete(self, session: Session, key: str) -> None:
        """Forget the object under ``key``, if there is one."""
        session.execute(delete(BlobPart).where(BlobPart.key == key))
        session.execute(delete(Blob).where(Blob.key == key))

    def keys(self, session: Session) -> Iterator[str]:
        """Yield the key of every object."""
        yield from session.scalars(select(Blob.key).execution_options(yield_per=1000))

    def check(self) -> None:
        """Nothing of its own can be out of reach: the database is checked by itself."""


def _compressed(part: memoryview) -> bytes:
    """Return a part as zstd; one whose beginning does not shrink is framed without much of a search."""
    probe = part[:PROBE_BYTES]
    shrinks = len(part) <= PROBE_BYTES or len(_compressor().compress(probe)) < SHRUNK * len(probe)
    return (_compressor() if shrinks else zstandard.ZstdCompressor(ZSTD_FRAMING)).compress(part)


def _compressor() -> zstandard.ZstdCompressor:
    return zstandard.ZstdCompressor(compression_params=ZSTD)
