"""Keys: make, find, revoke; and the audit trail."""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import bindparam, delete, func, literal, select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM, Caller
from app.access.key_schemas import KeyQuery
from app.access.key_tables import ApiKey, Login
from app.errors import NotFoundError
from app.http.paging import Part, Ways, fetch_page
from app.storage.database import utc_now

KEY_FORM: Final = re.compile(r"mgc_([0-9a-f]{16})_([A-Za-z0-9_-]{43})", re.ASCII)
SECRET_BYTES: Final = 32
LOGIN_LENGTH: Final = 43
HELD: Final = Ways({"created": (ApiKey.created_at, ApiKey.id)}, searched=(ApiKey.id, ApiKey.name))
KEYS: Final = ApiKey.metadata.tables["api_key"].c
ANYTHING: Final = select(literal(1).label("one")).subquery()
HOLDER: Final = select(
    KEYS.id, KEYS.secret_sha256, KEYS.scopes, KEYS.satellites, KEYS.expires_at, KEYS.revoked_at
).select_from(ANYTHING.outerjoin(ApiKey, KEYS.id == bindparam("key_id")))
"""One row also where there is no such key: what it takes to make one would tell a wrong id from a wrong secret."""


@dataclass(frozen=True, slots=True)
class Holder:
    """A key as the database has it: what it may do, where, and until when."""

    key_id: str
    secret_sha256: bytes
    scopes: frozenset[str]
    satellites: frozenset[str] | None
    expires_at: datetime | None
    revoked_at: datetime | None

    def is_in_force(self, now: datetime) -> bool:
        """Return whether the key is neither revoked nor expired."""
        return self.revoked_at is None and (self.expires_at is None or self.expires_at > now)


@dataclass(frozen=True, slots=True)
class NewKey:
    """A key in the only moment in which it is known."""

    row: ApiKey
    key: str


def secret_hash(secret: str) -> bytes:
    """Return what is kept of a secret of 256 random bits."""
    return hashlib.sha256(secret.encode("ascii")).digest()


class KeyRepository:
    """The keys of this service."""

    def __init__(self, session: Session, caller: Caller = SYSTEM) -> None:
        self.session = session
        self.caller = caller

    def create(
        self,
        scopes: Sequence[str],
        satellites: Sequence[str] | None = None,
        expires_at: datetime | None = None,
        name: str | None = None,
    ) -> NewKey:
        """Return a new key; its secret is not kept."""
        key_id, secret = secrets.token_hex(8), secrets.token_urlsafe(SECRET_BYTES)
        row = ApiKey(
            id=key_id,
            name=name,
            secret_sha256=secret_hash(secret),
            scopes=sorted({str(scope) for scope in scopes}),
            satellites=None if satellites is None else sorted(set(satellites)),
            created_at=utc_now(),
            created_by=self.caller.key_id,
            expires_at=expires_at,
        )
        self.session.add(row)
        record_event(self.session, self.caller, "key.create", key_id)
        return NewKey(row, f"mgc_{key_id}_{secret}")

    def revoke(self, key_id: str) -> ApiKey:
        """Return the key ``key_id``, revoked from now on."""
        row = self.session.get(ApiKey, key_id, with_for_update=True)
        if row is None:
            raise NotFoundError("no such key")
        if row.revoked_at is None:
            row.revoked_at = utc_now()
            record_event(self.session, self.caller, "key.revoke", key_id)
        return row

    def page(self, query: KeyQuery) -> Part[ApiKey]:
        """Return a part of the keys."""
        return fetch_page(self.session, select(ApiKey), HELD, query)

    def is_empty(self) -> bool:
        """Return whether there has never been a key."""
        return not self.session.scalar(select(func.count()).select_from(ApiKey))

    def find(self, key_id: str) -> Holder | None:
        """Return the key ``key_id``, if there is one; it takes as long where there is none."""
        row = self.session.connection().execute(HOLDER, {"key_id": key_id}).one()
        satellites = None if row.satellites is None else frozenset(row.satellites)
        found = Holder(
            row.id, row.secret_sha256, frozenset(row.scopes or ()), satellites, row.expires_at, row.revoked_at
        )
        return None if row.id is None else found

    def open_login(self, key_id: str, hours: float) -> str:
        """Return the token of a new dashboard login with the key ``key_id``."""
        token = secrets.token_urlsafe(SECRET_BYTES)
        now = utc_now()
        login = Login(
            token_sha256=secret_hash(token), key_id=key_id, created_at=now, expires_at=now + timedelta(hours=hours)
        )
        self.session.add(login)
        record_event(self.session, self.caller, "login", key_id)
        return token

    def close_login(self, token: str) -> None:
        """Forget a dashboard login."""
        if len(token) == LOGIN_LENGTH and token.isascii():
            self.session.execute(delete(Login).where(Login.token_sha256 == secret_hash(token)))

    def find_login(self, token: str) -> Login | None:
        """Return the login that ``token`` stands for, if there is one."""
        if len(token) != LOGIN_LENGTH or not token.isascii():
            return None
        return self.session.get(Login, secret_hash(token))
