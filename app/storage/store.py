"""What every store of bytes offers, the keys that bytes are kept under, and their digests."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from sqlalchemy.orm import Session

from app.errors import StoredObjectCorruptError


@dataclass(frozen=True, slots=True)
class Packed:
    """An object that is ready to be kept: its bytes, their SHA-256, and the parts that the database keeps, if any."""

    content: bytes
    sha256: str
    parts: tuple[bytes, ...] = ()

    @classmethod
    def of(cls, content: bytes | Packed) -> Packed:
        """Return ``content`` with its SHA-256, as it is where that is known already."""
        return content if isinstance(content, Packed) else cls(content, digest(content))


class Store(Protocol):
    """Keeps immutable objects; what `put` returns from is durable once the session's transaction is."""

    def pack(self, content: bytes, sha256: str) -> Packed:
        """Return ``content``, of the digest ``sha256``, ready to be kept: what needs no transaction is done before."""
        ...

    def put(self, session: Session, key: str, content: bytes | Packed) -> str:
        """Keep ``content`` under ``key`` and return its SHA-256, hexadecimal."""
        ...

    def put_all(self, session: Session, objects: Sequence[tuple[str, Packed]]) -> None:
        """Keep each of ``objects`` under its key."""
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


def raw_key(satellite_id: str, sha256: str) -> str:
    """Return the key of an upload's raw bytes; the satellite is part of it."""
    return f"raw/{satellite_id}/{sha256}"


def columns_key(session_id: str, sequence: int) -> str:
    """Return the key of the columnar form of a session's chunk."""
    return f"columns/{session_id}/{sequence}"


def residuals_key(parameter_set_id: str) -> str:
    """Return the key of a parameter set's residual table."""
    return f"residuals/{parameter_set_id}"


def moments_key(parameter_set_id: str) -> str:
    """Return the key of the moments of a parameter set's fit."""
    return f"moments/{parameter_set_id}"


def series_key(job_id: str) -> str:
    """Return the key of a job's series."""
    return f"series/{job_id}"
