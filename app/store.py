"""Where raw bytes and derived chunks lie: in the database by default, or in a folder or bucket.

An object is named by its key and known by the SHA-256 of its bytes, which every read verifies.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Final, Protocol

import zstandard
from sqlalchemy import BigInteger, ForeignKey, LargeBinary, String, delete, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.database import Base
from app.errors import StoredObjectCorruptError
from app.settings import Settings

PART_BYTES: Final = 1 << 22
ZSTD_LEVEL: Final = 1


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


BLOBS: Final = Blob.metadata.tables["blob"]
BLOB_PARTS: Final = Blob.metadata.tables["blob_part"]
"""Without the mapper, which doubles the time that an upload holds the writer's turn."""


class Store(Protocol):
    """Keeps immutable objects; what `put` returns from is durable once the session's transaction is."""

    def put(self, session: Session, key: str, content: bytes) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        ...

    def get(self, session: Session, key: str, sha256: str) -> bytes:
        """Return the bytes under ``key``; StoredObjectCorruptError where they are gone or not those of ``sha256``."""
        ...

    def delete(self, session: Session, key: str) -> None:
        """Forget the object under ``key``, if there is one."""
        ...

    def keys(self, session: Session) -> Iterator[str]:
        """Yield the key of every object."""
        ...

    def check(self) -> None:
        """Raise UnavailableError where the store cannot be reached."""
        ...


def digest(content: bytes) -> str:
    """Return the SHA-256 of ``content``, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def verified(key: str, content: bytes, sha256: str) -> bytes:
    """Return ``content`` where it has the digest ``sha256``."""
    if digest(content) != sha256:
        raise StoredObjectCorruptError(f"the stored object {key} does not have its digest")
    return content


class DatabaseStore:
    """Objects in the database, in the transaction of the rows that name them."""

    def put(self, session: Session, key: str, content: bytes) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        sha256 = digest(content)
        connection = session.connection()
        insert = postgresql.insert if connection.dialect.name == "postgresql" else sqlite.insert
        row = {"key": key, "sha256": sha256, "size_bytes": len(content)}
        if connection.execute(insert(BLOBS).on_conflict_do_nothing().returning(BLOBS.c.key), row).first() is not None:
            pack = zstandard.ZstdCompressor(ZSTD_LEVEL).compress
            for number, start in enumerate(range(0, len(content), PART_BYTES)):
                part = {"key": key, "number": number, "content": pack(content[start : start + PART_BYTES])}
                connection.execute(insert(BLOB_PARTS), part)
        return sha256

    def get(self, session: Session, key: str, sha256: str) -> bytes:
        """Return the bytes under ``key``, verified."""
        parts = session.scalars(select(BlobPart.content).where(BlobPart.key == key).order_by(BlobPart.number))
        unpack = zstandard.ZstdDecompressor().decompress
        try:
            content = b"".join(unpack(part, max_output_size=PART_BYTES) for part in parts)
        except zstandard.ZstdError as error:
            raise StoredObjectCorruptError(f"the stored object {key} cannot be decompressed") from error
        return verified(key, content, sha256)

    def delete(self, session: Session, key: str) -> None:
        """Forget the object under ``key``, if there is one."""
        session.execute(delete(BlobPart).where(BlobPart.key == key))
        session.execute(delete(Blob).where(Blob.key == key))

    def keys(self, session: Session) -> Iterator[str]:
        """Yield the key of every object."""
        yield from session.scalars(select(Blob.key).execution_options(yield_per=1000))

    def check(self) -> None:
        """Nothing of its own can be out of reach: the database is checked by itself."""


def open_store(settings: Settings) -> Store:
    """Return the store that the settings name."""
    if settings.store_url is None:
        return DatabaseStore()
    from app.object_store import open_url

    return open_url(settings.store_url)


def raw_key(satellite_id: str, sha256: str) -> str:
    """Return the key of an upload's raw bytes; the satellite is part of it."""
    return f"raw/{satellite_id}/{sha256}"


def columns_key(session_id: str, sequence: int) -> str:
    """Return the key of the columnar form of a session's chunk."""
    return f"columns/{session_id}/{sequence}"


def residuals_key(parameter_set_id: str) -> str:
    """Return the key of a parameter set's residual table."""
    return f"residuals/{parameter_set_id}"


def series_key(job_id: str) -> str:
    """Return the key of a job's series."""
    return f"series/{job_id}"
