"""Bodies of the sessions' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from app.http.schemas import Filter, PageQuery, Record, Slug, UtcTime


class ChunkRead(Record):
    """Bytes as they arrived."""

    sequence: int
    sha256: str
    size_bytes: int
    format: str
    samples: int
    created_at: UtcTime


class SessionRead(Record):
    """A session as it stands."""

    id: str
    satellite: str
    magnetometer: str
    state: Literal["open", "closed"]
    sha256: str | None
    size_bytes: int
    samples: int
    used_samples: int
    data_from: UtcTime | None
    data_until: UtcTime | None
    columns: list[str]
    quality: dict[str, JsonValue]
    raw_removed_at: UtcTime | None
    created_at: UtcTime
    created_by: str | None
    closed_at: UtcTime | None
    job_id: str | None = Field(None, description="The job that the magnetometer's policy queued for this session.")


class SessionDetail(SessionRead):
    """A session with the bytes that it came in."""

    chunks: list[ChunkRead]


class UploadQuery(Filter):
    """Where an upload belongs."""

    magnetometer: Slug
    open: bool = Field(False, description="Leave the session open for further chunks.")


class SessionQuery(PageQuery):
    """Which sessions to list."""

    satellite: Slug | None = None
    magnetometer: Slug | None = None
    state: Literal["open", "closed"] | None = None
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")
    since: UtcTime | None = None
    until: UtcTime | None = None


class SampleQuery(Filter):
    """Which samples, and how."""

    since: UtcTime | None = None
    until: UtcTime | None = None
    flags: bool = Field(False, description="Add the column magcal_flags.")
    format: Literal["csv", "ndjson", "json", "parquet"] | None = Field(None, description="Instead of Accept.")
