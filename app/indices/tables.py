"""Tables of index files and of files of coefficients: they serve all satellites."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import CheckConstraint, Index, LargeBinary, String
from sqlalchemy.orm import Mapped, mapped_column

from app.storage.database import Base, JsonColumn


class IndexFile(Base):
    """One index file as it was sent, and its intervals as jobs take them."""

    __tablename__ = "index_file"
    __table_args__ = (
        CheckConstraint("name IN ('RC', 'Dst', 'Kp')", name="name"),
        Index(None, "created_at", "id"),
        Index(None, "name", "first"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str] = mapped_column(String(8))
    format: Mapped[str] = mapped_column(String(16))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    rows: Mapped[int]
    missing: Mapped[int]
    first: Mapped[datetime]
    last: Mapped[datetime]
    content: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    """What was sent, compressed with zstd."""
    intervals: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    """`magcal_core.field.index.Index.to_bytes`."""
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))


class FieldFile(Base):
    """One file of coefficients as it was sent."""

    __tablename__ = "field_file"
    __table_args__ = (Index(None, "created_at", "id"),)

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    name: Mapped[str | None] = mapped_column(String(200))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    details: Mapped[dict[str, object]] = mapped_column(JsonColumn)
    """Format, model, degrees, order and validity."""
    content: Mapped[bytes] = mapped_column(LargeBinary, deferred=True)
    """What was sent, compressed with zstd."""
    created_at: Mapped[datetime]
    created_by: Mapped[str | None] = mapped_column(String(32))
