"""Table of what happened: each row is written in the transaction that made it true."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import BigInteger, Index, Integer, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class OutboxEntry(Base):
    """One thing that happened.

    ``id`` counts as rows are written, ``position`` as they are committed: a reader goes by the position, which an entry
    has once it is sure that none before it is still to come (`app.outbox.log`).
    """

    __tablename__ = "outbox"
    __table_args__ = (
        UniqueConstraint("position"),
        Index(None, "at"),
        {"sqlite_autoincrement": True},
    )

    id: Mapped[int] = mapped_column(BigInteger().with_variant(Integer(), "sqlite"), primary_key=True)
    position: Mapped[int | None] = mapped_column(BigInteger)
    event_id: Mapped[str] = mapped_column(String(32))
    type: Mapped[str] = mapped_column(String(40))
    at: Mapped[datetime]
    satellite_id: Mapped[str | None] = mapped_column(String(63))
    magnetometer_id: Mapped[str | None] = mapped_column(String(63))
    owner: Mapped[str | None] = mapped_column(String(32))
    data: Mapped[dict[str, object]] = mapped_column(JsonColumn)


class OutboxMark(Base):
    """How far a subscriber has come."""

    __tablename__ = "outbox_mark"

    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    position: Mapped[int] = mapped_column(BigInteger)
