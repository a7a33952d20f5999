"""Idempotency-Key: the same key with the same request gives what the first one made."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Annotated

from fastapi import Header
from sqlalchemy import String
from sqlalchemy.orm import Mapped, Session, mapped_column

from app.access.caller import Caller
from app.errors import IdempotencyMismatchError, InProgressError
from app.storage.database import Base, utc_now

KeyHeader = Annotated[
    str | None, Header(alias="Idempotency-Key", min_length=1, max_length=200, pattern=r"^[\x21-\x7e]+$")
]


class IdempotencyKey(Base):
    """What was made by a request with an Idempotency-Key; each API key has its own."""

    __tablename__ = "idempotency_key"

    owner: Mapped[str] = mapped_column(String(32), primary_key=True)
    key: Mapped[str] = mapped_column(String(200), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    resource_id: Mapped[str] = mapped_column(String(32))
    created_at: Mapped[datetime]


class Running:
    """The requests with an Idempotency-Key that this process is working on."""

    def __init__(self) -> None:
        self._keys: set[tuple[str, str]] = set()

    @contextmanager
    def hold(self, caller: Caller, key: str | None) -> Iterator[None]:
        """Hold ``key`` for the caller; InProgressError where another request holds it."""
        if key is None:
            yield
            return
        mine = (caller.key_id, key)
        if mine in self._keys:
            raise InProgressError("the first request with this Idempotency-Key has not ended yet")
        self._keys.add(mine)
        try:
            yield
        finally:
            self._keys.discard(mine)


def fingerprint(*parts: str) -> str:
    """Return what makes a request the same as another."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def recall(session: Session, caller: Caller, key: str | None, request: str) -> str | None:
    """Return the id of what the first request with ``key`` made, None where this is the first.

    Raises
    ------
    IdempotencyMismatchError
        The first request was another one than that of the fingerprint ``request``.
    """
    row = None if key is None else session.get(IdempotencyKey, (caller.key_id, key))
    if row is not None and row.fingerprint != request:
        raise IdempotencyMismatchError("this Idempotency-Key was used with another request")
    return None if row is None else row.resource_id


def remember(session: Session, caller: Caller, key: str | None, request: str, resource_id: str) -> None:
    """Keep what a request with ``key`` made, in the transaction that makes it."""
    if key is not None:
        session.merge(
            IdempotencyKey(
                owner=caller.key_id, key=key, fingerprint=request, resource_id=resource_id, created_at=utc_now()
            )
        )
