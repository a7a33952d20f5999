"""Tables of connectors: what was asked of other services and when, so that their limits hold over restarts."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey, Index, LargeBinary, String, Text
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base


class ConnectorRequest(Base):
    """One request to a source: written down before it is sent, so that a kill does not let it be sent again.

    It stays under the catalogue number when the satellite is removed: the source was asked all the same. One without a
    number is from before they were kept.
    """

    __tablename__ = "connector_request"
    __table_args__ = (
        Index(None, "source", "satellite_id", "asked_at"),
        Index(None, "source", "catalogue_number", "asked_at"),
        Index(None, "source", "asked_at"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    source: Mapped[str] = mapped_column(String(32))
    satellite_id: Mapped[str | None] = mapped_column(ForeignKey("satellite.id"))
    catalogue_number: Mapped[str | None] = mapped_column(String(16))
    asked_at: Mapped[datetime]
    outcome: Mapped[str | None] = mapped_column(String(500))


class ConnectorStop(Base):
    """A source that must not be asked any more until a person starts it again."""

    __tablename__ = "connector_stop"

    source: Mapped[str] = mapped_column(String(32), primary_key=True)
    reason: Mapped[str] = mapped_column(String(500))
    stopped_at: Mapped[datetime]


class ConnectorMark(Base):
    """How far a pull has come; moved in the transaction that keeps what was pulled, and removed with its satellite.

    ``remembers_from``: the times of the rows that were taken from then on are in `ConnectorSeen`, None: no time is.
    """

    __tablename__ = "connector_mark"

    name: Mapped[str] = mapped_column(String(200), primary_key=True)
    satellite_id: Mapped[str | None] = mapped_column(ForeignKey("satellite.id"))
    mark: Mapped[str] = mapped_column(Text)
    updated_at: Mapped[datetime]
    remembers_from: Mapped[datetime | None]
    looked_back_at: Mapped[datetime | None]


class ConnectorSeen(Base):
    """The times of rows that a pull took with one page, so that they are not taken again where it looks back.

    ``times`` are int64, little-endian, microseconds since 1970; negative ones of rows that lacked a reading.
    """

    __tablename__ = "connector_seen"
    __table_args__ = (Index(None, "name", "until"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    satellite_id: Mapped[str] = mapped_column(ForeignKey("satellite.id"))
    until: Mapped[datetime]
    times: Mapped[bytes] = mapped_column(LargeBinary)
