"""Who asks, and whether they may: bearer keys and dashboard logins."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import time
from collections import OrderedDict, deque
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

from app.access.caller import Caller, Scope
from app.access.key_repository import KEY_FORM, Holder, KeyRepository, secret_hash
from app.access.oidc import Issuer
from app.errors import ScopeRequiredError, TooManyFailuresError, UnauthorizedError
from app.http.entity_tags import TRUSTED_S
from app.http.guards import MARK
from app.http.services import HttpServices, services_of
from app.storage.database import utc_now

LOGIN_COOKIE: Final = "magcal_login"
SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
DUMMY_HASH: Final = secret_hash("")
WINDOW_S: Final = 60.0
MOST_SUSPECTS: Final = 10_000
MOST_RECENT: Final = 1000

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
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()
        self._lock = Lock()

    def check(self, *suspects: str) -> None:
        """Raise `TooManyFailuresError` where a suspect has failed too often within the last minute."""
        with self._lock:
            for suspect in suspects:
                if len(self._recent(suspect)) >= self._most:
                    raise TooManyFailuresError("too many wrong keys; wait a minute")

    def note(self, *suspects: str) -> None:
        """Count a failure of each suspect."""
        with self._lock:
            for suspect in suspects:
                recent = self._recent(suspect)
                recent.append(time.monotonic())
                self._failures[suspect] = recent
                self._failures.move_to_end(suspect)
            while len(self._failures) > MOST_SUSPECTS:
                self._failures.popitem(last=False)

    def _recent(self, suspect: str) -> deque[float]:
        """Return when a suspect failed within the last minute."""
        failures = self._failures.get(suspect) or deque(maxlen=self._most)
        while failures and failures[0] <= time.monotonic() - WINDOW_S:
            failures.popleft()
        return failures


@dataclass(frozen=True, slots=True)
class _Seen:
    """What a key stands for, as the database had it at ``at_s`` of the monotonic clock."""

    at_s: float
    holder: Holder


class RecentKeys:
    """Keys that were right a moment ago, so that a burst of requests does not ask the database for each.

    A key that another process revokes is refused after `TRUSTED_S` at the latest.
    """

    def __init__(self) -> None:
        self._seen: OrderedDict[bytes, _Seen] = OrderedDict()
        self._turns: WeakValueDictionary[bytes, asyncio.Lock] = WeakValueDictionary()

    def turn(self, key: str) -> asyncio.Lock:
        """Return the lock under which the database is asked for ``key``."""
        return self._turns.setdefault(_mark(key), asyncio.Lock())

    def find(self, key: str) -> Holder | None:
        """Return what ``key`` stands for where it was right within `TRUSTED_S` and has not expired since."""
        seen = self._seen.get(_mark(key))
        if seen is None or time.monotonic() - seen.at_s > TRUSTED_S:
            return None
        return seen.holder if seen.holder.is_in_force(utc_now()) else None

    def note(self, key: str, at_s: float, holder: Holder) -> None:
        """Remember that the database was asked for ``key`` at ``at_s`` and had it as ``holder``."""
        self._seen[_mark(key)] = _Seen(at_s, holder)
        while len(self._seen) > MOST_RECENT:
            self._seen.popitem(last=False)

    def drop(self, key: str) -> None:
        """Ask the database for ``key`` anew."""
        self._seen.pop(_mark(key), None)

    def forget(self) -> None:
        """Ask the database for every key anew."""
        self._seen.clear()


@dataclass(frozen=True, kw_only=True)
class AccessServices(HttpServices):
    """What access adds to what the application holds."""

    failures: FailureLimiter
    recent_keys: RecentKeys
    clock: SteadyClock
    issuer: Issuer | None


def _mark(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()


def verify_key(session: Session, key: str, now: datetime) -> Holder | None:
    """Return who holds ``key`` where it is right and in force ``now``; takes the same time for every wrong one."""
    form = KEY_FORM.fullmatch(key)
    holder = KeyRepository(session).find(form[1]) if form else None
    kept = DUMMY_HASH if holder is None else holder.secret_sha256
    given = secret_hash(form[2] if form else "no secret")
    is_right = hmac.compare_digest(kept, given)
    return holder if holder is not None and is_right and holder.is_in_force(now) else None


def is_same_origin(request: Request) -> bool:
    """Return whether the request comes from a page of this service.

    Browsers send ``Sec-Fetch-Site`` where the connection is secure or local; elsewhere ``Origin`` tells it.
    """
    site = request.headers.get("sec-fetch-site")
    if site is not None:
        return site == "same-origin"
    return urlsplit(request.headers.get("origin", "")).netloc == request.headers.get("host", "-")


def _verify_login(session: Session, request: Request, now: datetime) -> Holder | None:
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
    holder = keys.find(login.key_id)
    return holder if holder is not None and holder.is_in_force(now) else None


def authenticate(request: Request) -> Caller:
    """Return the caller that the request's key, or else its login cookie, stands for, as the database has it now."""
    held = services_of(request.app, AccessServices)
    limiter, issuer = held.failures, held.issuer
    scheme, key = get_authorization_scheme_param(request.headers.get("authorization"))
    address, asked_s = _address(request), time.monotonic()
    if issuer is not None and scheme.lower() == "bearer" and issuer.is_token(key):
        try:
            return issuer.caller(key, address, request.state.request_id)
        except UnauthorizedError:
            limiter.check(f"address {address}")
            limiter.note(f"address {address}")
            raise
    with held.database.read() as session:
        if scheme.lower() == "bearer":
            holder = verify_key(session, key, held.clock.now())
        else:
            holder = None if scheme else _verify_login(session, request, held.clock.now())
    if holder is None:
        form = KEY_FORM.fullmatch(key)
        suspects = [f"address {address}", *([f"key {form[1]}"] if form else [])]
        if key:
            limiter.check(*suspects)
            limiter.note(*suspects)
        raise UnauthorizedError
    if scheme:
        held.recent_keys.note(key, asked_s, holder)
    return _caller(holder, request)


def _caller(holder: Holder, request: Request) -> Caller:
    return Caller(holder.key_id, holder.scopes, holder.satellites, _address(request), request.state.request_id)


async def identify(request: Request) -> Caller:
    """Return the caller that the request's key stands for, as the database had it `TRUSTED_S` ago at the earliest."""
    recent = services_of(request.app, AccessServices).recent_keys
    scheme, key = get_authorization_scheme_param(request.headers.get("authorization"))
    found = recent.find(key) if scheme.lower() == "bearer" else None
    if found is None and scheme.lower() == "bearer":
        async with recent.turn(key):  # of a crowd with one key, the first asks for all
            found = recent.find(key)
            if found is None:
                return await run_in_threadpool(authenticate, request)
    if found is None:
        return await run_in_threadpool(authenticate, request)
    return _caller(found, request)


def _address(request: Request) -> str:
    return request.client.host if request.client else "unknown"


def is_still_valid(request: Request) -> bool:
    """Return whether the key or login of a request that goes on is still in force."""
    try:
        authenticate(request)
    except UnauthorizedError:
        return False
    return True


def require(*scopes: Scope) -> Callable[[Request, object], Coroutine[None, None, Caller]]:
    """Return a dependency that lets only keys with one of ``scopes`` pass.

    Whom it has let pass it knows again within the request. A key that is refused for its scope is not remembered, so
    that its refusal takes as long as that of a wrong one.
    """
    names = " or ".join(scopes)

    async def check(request: Request, _documented: Annotated[object, Depends(bearer)]) -> Caller:
        known: Caller | None = getattr(request.state, "caller", None)
        caller = request.state.caller = await identify(request) if known is None else known
        if not caller.may(*scopes):
            recent = services_of(request.app, AccessServices).recent_keys
            recent.drop(get_authorization_scheme_param(request.headers.get("authorization"))[1])
            raise ScopeRequiredError(f"the key needs the scope {names}")
        return caller

    check.__dict__[MARK] = scopes
    return check


Reader = Annotated[Caller, Depends(require(Scope.READ))]
Station = Annotated[Caller, Depends(require(Scope.INGEST))]
OrbitSource = Annotated[Caller, Depends(require(Scope.INGEST, Scope.OPERATE))]
Operator = Annotated[Caller, Depends(require(Scope.OPERATE))]
Administrator = Annotated[Caller, Depends(require(Scope.ADMIN))]
