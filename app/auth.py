"""Who asks, and whether they may: bearer keys and dashboard logins."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import time
from collections import OrderedDict
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from datetime import datetime, timedelta
from threading import Lock
from typing import Annotated, Final
from urllib.parse import urlsplit
from weakref import WeakValueDictionary

from fastapi import Depends, Request
from fastapi.security import HTTPBearer
from fastapi.security.utils import get_authorization_scheme_param
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from app.database import Database, utc_now
from app.errors import ScopeRequiredError, TooManyFailuresError, UnauthorizedError
from app.keys.repository import KEY_FORM, Caller, KeyRepository, Scope, secret_hash
from app.keys.tables import ApiKey
from app.oidc import Issuer

LOGIN_COOKIE: Final = "magcal_login"
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
DUMMY_HASH: Final = secret_hash("")
WINDOW_S: Final = 60.0
MOST_SUSPECTS: Final = 10_000
MOST_RECENT: Final = 1000
TRUSTED_S: Final = 0.5

bearer = HTTPBearer(auto_error=False, description="A key of `magcal keys create`: `mgc_<id>_<secret>`.")


class SteadyClock:
    """Time that does not go back while this process runs, so that a clock set back revives no key."""

    def __init__(self) -> None:
        self._begun, self._begun_s = utc_now(), time.monotonic()

    def now(self) -> datetime:
        """Return the machine's time, or what it must be at the least."""
        return max(utc_now(), self._begun + timedelta(seconds=time.monotonic() - self._begun_s))


class FailureLimiter:
    """Counts wrong keys per address and per key id over a minute; right keys are not counted."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._failures: OrderedDict[str, list[float]] = OrderedDict()
        self._lock = Lock()

    def check(self, *suspects: str) -> None:
        """Raise `TooManyFailuresError` where a suspect has failed too often within the last minute."""
        since = time.monotonic() - WINDOW_S
        with self._lock:
            for suspect in suspects:
                recent = [at for at in self._failures.get(suspect, ()) if at > since]
                if len(recent) >= self._most:
                    raise TooManyFailuresError("too many wrong keys; wait a minute")

    def note(self, *suspects: str) -> None:
        """Count a failure of each suspect."""
        now = time.monotonic()
        with self._lock:
            for suspect in suspects:
                recent = [at for at in self._failures.pop(suspect, ()) if at > now - WINDOW_S]
                self._failures[suspect] = [*recent, now][-self._most :]
            while len(self._failures) > MOST_SUSPECTS:
                self._failures.popitem(last=False)


@dataclass(frozen=True, slots=True)
class _Holder:
    """What a key stands for, as the database had it at ``seen_s`` of the monotonic clock."""

    seen_s: float
    key_id: str
    scopes: frozenset[str]
    satellites: frozenset[str] | None
    expires_at: datetime | None


class RecentKeys:
    """Keys that were right a moment ago, so that a burst of requests does not ask the database for each.

    A key that another process revokes is refused after `TRUSTED_S` at the latest.
    """

    def __init__(self) -> None:
        self._holders: OrderedDict[bytes, _Holder] = OrderedDict()
        self._turns: WeakValueDictionary[bytes, asyncio.Lock] = WeakValueDictionary()

    def turn(self, key: str) -> asyncio.Lock:
        """Return the lock under which the database is asked for ``key``."""
        return self._turns.setdefault(_mark(key), asyncio.Lock())

    def find(self, key: str) -> _Holder | None:
        """Return what ``key`` stands for where it was right within `TRUSTED_S` and has not expired since."""
        found = self._holders.get(_mark(key))
        if found is None or time.monotonic() - found.seen_s > TRUSTED_S:
            return None
        return found if found.expires_at is None or found.expires_at > utc_now() else None

    def note(self, key: str, seen_s: float, row: ApiKey) -> None:
        """Remember that the database was asked for ``key`` at ``seen_s`` and had it as ``row``."""
        satellites = None if row.satellites is None else frozenset(row.satellites)
        self._holders[_mark(key)] = _Holder(seen_s, row.id, frozenset(row.scopes), satellites, row.expires_at)
        while len(self._holders) > MOST_RECENT:
            self._holders.popitem(last=False)

    def forget(self) -> None:
        """Ask the database for every key anew."""
        self._holders.clear()


def _mark(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()


def verify_key(session: Session, key: str, now: datetime) -> ApiKey | None:
    """Return the key's row where ``key`` is right and in force ``now``; takes the same time for every wrong one."""
    form = KEY_FORM.fullmatch(key)
    row = KeyRepository(session).find(form[1]) if form else None
    kept = DUMMY_HASH if row is None else row.secret_sha256
    given = secret_hash(form[2] if form else "no secret")
    is_right = hmac.compare_digest(kept, given)
    return row if row is not None and is_right and _is_in_force(row, now) else None


def _is_in_force(row: ApiKey, now: datetime) -> bool:
    return row.revoked_at is None and (row.expires_at is None or row.expires_at > now)


def is_same_origin(request: Request) -> bool:
    """Return whether the request comes from a page of this service.

    Browsers send ``Sec-Fetch-Site`` where the connection is secure or local; elsewhere ``Origin`` tells it.
    """
    site = request.headers.get("sec-fetch-site")
    if site is not None:
        return site == "same-origin"
    return urlsplit(request.headers.get("origin", "")).netloc == request.headers.get("host", "-")


def _verify_login(session: Session, request: Request, now: datetime) -> ApiKey | None:
    """Return the key behind the login cookie; changes need the page's own origin, so that no other site can ask."""
    token = request.cookies.get(LOGIN_COOKIE)
    if token is None:
        return None
    if request.method not in SAFE_METHODS and not is_same_origin(request):
        return None
    keys = KeyRepository(session)
    login = keys.find_login(token)
    if login is None or login.expires_at <= now:
        return None
    row = keys.find(login.key_id)
    return row if row is not None and _is_in_force(row, now) else None


def authenticate(request: Request) -> Caller:
    """Return the caller that the request's key, or else its login cookie, stands for, as the database has it now."""
    database: Database = request.app.state.database
    limiter: FailureLimiter = request.app.state.failures
    scheme, key = get_authorization_scheme_param(request.headers.get("authorization"))
    clock: SteadyClock = request.app.state.clock
    address, asked_s = _address(request), time.monotonic()
    issuer: Issuer | None = request.app.state.issuer
    if issuer is not None and scheme.lower() == "bearer" and issuer.is_token(key):
        try:
            return issuer.caller(key, address, request.state.request_id)
        except UnauthorizedError:
            limiter.check(f"address {address}")
            limiter.note(f"address {address}")
            raise
    with database.read() as session:
        if scheme.lower() == "bearer":
            row = verify_key(session, key, clock.now())
        else:
            row = None if scheme else _verify_login(session, request, clock.now())
    if row is None:
        form = KEY_FORM.fullmatch(key)
        suspects = [f"address {address}", *([f"key {form[1]}"] if form else [])]
        if key:
            limiter.check(*suspects)
            limiter.note(*suspects)
        raise UnauthorizedError
    if scheme:
        recent: RecentKeys = request.app.state.recent
        recent.note(key, asked_s, row)
    satellites = None if row.satellites is None else frozenset(row.satellites)
    return Caller(row.id, frozenset(row.scopes), satellites, address, request.state.request_id)


async def identify(request: Request, _documented: Annotated[object, Depends(bearer)] = None) -> Caller:
    """Return the caller that the request's key stands for, as the database had it `TRUSTED_S` ago at the earliest."""
    recent: RecentKeys = request.app.state.recent
    scheme, key = get_authorization_scheme_param(request.headers.get("authorization"))
    found = recent.find(key) if scheme.lower() == "bearer" else None
    if found is None and scheme.lower() == "bearer":
        async with recent.turn(key):  # of a crowd with one key, the first asks for all
            found = recent.find(key)
            if found is None:
                return await run_in_threadpool(authenticate, request)
    if found is None:
        return await run_in_threadpool(authenticate, request)
    return Caller(found.key_id, found.scopes, found.satellites, _address(request), request.state.request_id)


def _address(request: Request) -> str:
    return request.client.host if request.client else "unknown"


def is_still_valid(request: Request) -> bool:
    """Return whether the key or login of a request that goes on is still in force."""
    try:
        authenticate(request)
    except UnauthorizedError:
        return False
    return True


def require(*scopes: Scope) -> Callable[[Caller], Coroutine[None, None, Caller]]:
    """Return a dependency that lets only keys with one of ``scopes`` pass."""
    names = " or ".join(scopes)

    async def check(caller: Annotated[Caller, Depends(identify)]) -> Caller:
        if not caller.may(*scopes):
            raise ScopeRequiredError(f"the key needs the scope {names}")
        return caller

    check.__dict__["scopes"] = scopes
    return check


Reader = Annotated[Caller, Depends(require(Scope.READ))]
Station = Annotated[Caller, Depends(require(Scope.INGEST))]
OrbitSource = Annotated[Caller, Depends(require(Scope.INGEST, Scope.OPERATE))]
Operator = Annotated[Caller, Depends(require(Scope.OPERATE))]
Administrator = Annotated[Caller, Depends(require(Scope.ADMIN))]
