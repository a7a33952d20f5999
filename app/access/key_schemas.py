"""Bodies of the keys' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.http.schemas import Body, Name, NewestFirst, PageQuery, Record, Search, Slug, UtcTime

ScopeName = Literal["read", "ingest", "operate", "admin"]


class KeyCreate(Body):
    """What a new key may do, where and until when."""

    scopes: list[ScopeName] = Field(min_length=1, max_length=4)
    satellites: list[Slug] | None = Field(None, min_length=1, max_length=1000)
    expires_at: UtcTime | None = None
    name: Name | None = None


class KeyQuery(NewestFirst):
    """Which keys to list."""

    q: Search | None = Field(None, description="Part of an id or name.")


class KeyShort(Record):
    """A key without the satellites that it is bound to, in under 500 bytes."""

    id: str
    name: str | None
    scopes: list[str]
    created_at: UtcTime
    created_by: str | None
    expires_at: UtcTime | None
    revoked_at: UtcTime | None


class KeyRead(KeyShort):
    """A key without its secret, which nobody knows but its holder."""

    satellites: list[str] | None


class KeyCreated(KeyRead):
    """A new key; `key` is shown this once."""

    key: str


class AuditQuery(PageQuery):
    """Which lines of the audit trail to list."""

    q: Search | None = Field(None, description="Part of an action, subject, satellite, key's id or reason.")
    sort: Literal["at", "-at"] = Field("-at", description="`-at`: the newest first.")


class AuditShort(Record):
    """One line of the audit trail without the reason, in under 500 bytes."""

    id: str
    at: UtcTime
    key_id: str | None
    action: str
    subject: str
    satellite_id: str | None
    address: str | None
    request_id: str | None


class AuditRead(AuditShort):
    """One line of the audit trail."""

    reason: str | None = Field(description="In the words of who did it, where the call asks for one.")
