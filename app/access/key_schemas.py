"""Bodies of the keys' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.http.schemas import Body, Name, Record, Slug, UtcTime

ScopeName = Literal["read", "ingest", "operate", "admin"]


class KeyCreate(Body):
    """What a new key may do, where and until when."""

    scopes: list[ScopeName] = Field(min_length=1, max_length=4)
    satellites: list[Slug] | None = Field(None, min_length=1, max_length=1000)
    expires_at: UtcTime | None = None
    name: Name | None = None


class KeyRead(Record):
    """A key without its secret, which nobody knows but its holder."""

    id: str
    name: str | None
    scopes: list[str]
    satellites: list[str] | None
    created_at: UtcTime
    created_by: str | None
    expires_at: UtcTime | None
    revoked_at: UtcTime | None


class KeyCreated(KeyRead):
    """A new key; `key` is shown this once."""

    key: str


class AuditRead(Record):
    """One line of the audit trail."""

    id: str
    at: UtcTime
    key_id: str | None
    action: str
    subject: str
    satellite_id: str | None
    address: str | None
    request_id: str | None
