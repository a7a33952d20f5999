"""Bearer tokens of an OpenID Connect issuer, beside magcal's own keys (the extra ``oidc``).

A token is believed only as far as it goes: signed with one of the issuer's published keys by an asymmetric algorithm of
a fixed list, for this audience, not expired, and with the claims that say what its bearer may do. Nothing in a token
is an address that is asked, and no key comes from a token.
"""

from __future__ import annotations

import hashlib
import re
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import structlog
from pydantic import BaseModel, ConfigDict, JsonValue, TypeAdapter, ValidationError

from app.access.caller import Caller, Scope
from app.errors import UnauthorizedError, UnavailableError
from app.http.schemas import Slug
from app.settings import Settings

if TYPE_CHECKING:
    from joserfc.jwk import KeySet

ALGORITHMS: Final = ("RS256", "PS256", "ES256", "EdDSA")
"""None that a shared secret could sign, and not ``none``."""
KEY_TYPES: Final = frozenset({"RSA", "EC", "OKP"})
LEEWAY_S: Final = 30
LONGEST_LIFE_S: Final = 86_400
"""A token cannot be revoked here; one that is valid for longer than a day is not taken."""
KEYS_FRESH_S: Final = 600.0
ASK_AGAIN_S: Final = 30.0
"""A key that is not known is asked for, but not more often than this: tokens cost nothing to invent."""
MOST_TOKEN_BYTES: Final = 8192
MOST_ANSWER_BYTES: Final = 1 << 20
TIMEOUT_S: Final = 5.0
FORM: Final = re.compile(r"[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+", re.ASCII)
PLAIN_SUBJECT: Final = re.compile(r"[A-Za-z0-9@._-]{1,27}", re.ASCII)
ALL: Final = "*"

log = structlog.get_logger()
_satellites = TypeAdapter(list[Slug])


class _Discovery(BaseModel):
    """What of the issuer's own description is needed."""

    model_config = ConfigDict(extra="ignore", strict=True)
    issuer: str
    jwks_uri: str


class _Keys(BaseModel):
    """The issuer's published keys."""

    model_config = ConfigDict(extra="ignore", strict=True)
    keys: list[dict[str, JsonValue]]


@dataclass(frozen=True, slots=True)
class _Known:
    """The keys as they were asked for at ``at_s`` of the monotonic clock."""

    keys: KeySet
    ids: frozenset[str]
    at_s: float


class Issuer:
    """The one issuer whose tokens are taken; its keys are asked for when the first token comes."""

    def __init__(self, settings: Settings) -> None:
        self._url = str(settings.oidc_issuer)
        self._audience = settings.oidc_audience
        self._scope_claim = settings.oidc_scope_claim
        self._satellite_claim = settings.oidc_satellite_claim
        self._known: _Known | None = None
        self._lock = threading.Lock()

    @staticmethod
    def is_token(text: str) -> bool:
        """Return whether ``text`` has the form of a signed token."""
        return len(text) <= MOST_TOKEN_BYTES and FORM.fullmatch(text) is not None

    def caller(self, token: str, address: str | None, request_id: str | None) -> Caller:
        """Return the caller that ``token`` stands for.

        Raises
        ------
        UnauthorizedError
            The token is not one that this issuer made for this service, is not in force, or has no scope.
        UnavailableError
            The issuer's keys are needed and cannot be had.
        """
        claims = self._verified(token)
        scopes = frozenset(_words(claims.get(self._scope_claim))) & frozenset(map(str, Scope))
        subject = claims.get("sub")
        if not scopes or not isinstance(subject, str) or not subject:
            raise UnauthorizedError
        return Caller(_key_id(subject), scopes, self._reach(claims), address, request_id)

    def _reach(self, claims: Mapping[str, object]) -> frozenset[str] | None:
        """Return the satellites that the token is bound to, None for all: only the claim ``*`` says all."""
        named = _words(claims.get(self._satellite_claim))
        if named == [ALL]:
            return None
        try:
            return frozenset(_satellites.validate_python(named))
        except ValidationError:
            raise UnauthorizedError from None

    def _verified(self, token: str) -> Mapping[str, object]:
        from joserfc import jws, jwt
        from joserfc.errors import JoseError

        try:
            header = jws.extract_compact(token.encode("ascii")).headers()
            key_id = header.get("kid")
            if not isinstance(key_id, str):
                raise UnauthorizedError
            claims = jwt.decode(token, self._keys_with(key_id), algorithms=ALGORITHMS).claims
            registry = jwt.JWTClaimsRegistry(
                leeway=LEEWAY_S,
                iss={"essential": True, "value": self._url},
                aud={"essential": True, "value": str(self._audience)},
                exp={"essential": True},
                sub={"essential": True},
            )
            registry.validate(claims)
        except (JoseError, ValueError, TypeError) as error:
            log.info("token_refused", why=type(error).__name__)
            raise UnauthorizedError from None
        ends = claims["exp"]
        if not isinstance(ends, int | float) or ends > time.time() + LONGEST_LIFE_S + LEEWAY_S:
            log.info("token_refused", why="it is valid for too long")
            raise UnauthorizedError
        return dict(claims)

    def _keys_with(self, key_id: str) -> KeySet:
        with self._lock:
            known, now = self._known, time.monotonic()
            age_s = now - known.at_s if known is not None else float("inf")
            if age_s > KEYS_FRESH_S or (known is not None and key_id not in known.ids and age_s > ASK_AGAIN_S):
                known = self._known = self._asked(known, now)
            if known is None:
                raise UnavailableError("the issuer's keys cannot be had; try again")
            return known.keys

    def _asked(self, before: _Known | None, now_s: float) -> _Known | None:
        """Return the keys that the issuer publishes now; those of before where it does not answer."""
        import httpx2
        from joserfc.errors import JoseError
        from joserfc.jwk import KeySet

        try:
            found = _Discovery.model_validate_json(
                _content(f"{self._url.rstrip('/')}/.well-known/openid-configuration")
            )
            if found.issuer != self._url or not _is_safe(found.jwks_uri):
                raise ValueError("the issuer's description is of another issuer, or its keys come in the clear")
            listed = _Keys.model_validate_json(_content(found.jwks_uri)).keys
            usable = [one for one in listed if one.get("kty") in KEY_TYPES and one.get("use", "sig") == "sig"]
            keys = KeySet.import_key_set({"keys": usable})  # type: ignore[typeddict-item]
        except (httpx2.HTTPError, JoseError, ValueError) as error:
            log.warning("issuer_failed", error=str(error))
            return before
        return _Known(keys, frozenset(str(one["kid"]) for one in usable if "kid" in one), now_s)


def _content(url: str) -> bytes:
    import httpx2

    with httpx2.Client(timeout=TIMEOUT_S, follow_redirects=False) as client, client.stream("GET", url) as answer:
        answer.raise_for_status()
        pieces, size = [], 0
        for piece in answer.iter_bytes():
            size += len(piece)
            if size > MOST_ANSWER_BYTES:
                raise ValueError("the issuer's answer is too large")
            pieces.append(piece)
    return b"".join(pieces)


def _is_safe(url: str) -> bool:
    """Return whether nobody on the way can change what ``url`` answers."""
    parts = urlsplit(url)
    return parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in {"127.0.0.1", "::1", "localhost"})


def _words(claim: object) -> list[str]:
    """Return the words of a claim: a list of strings, or one string with blanks between them."""
    if isinstance(claim, str):
        return claim.split()
    return [one for one in claim if isinstance(one, str)] if isinstance(claim, list) else []


def _key_id(subject: str) -> str:
    """Return what the audit trail calls the bearer: the subject where it is short and plain, else its hash."""
    if PLAIN_SUBJECT.fullmatch(subject):
        return f"oidc:{subject}"
    return f"oidc#{hashlib.sha256(subject.encode()).hexdigest()[:27]}"


def open_issuer(settings: Settings) -> Issuer | None:
    """Return the issuer that the settings name, if they name one.

    Raises
    ------
    UnavailableError
        Its audience is missing, its address is not safe, or the extra ``oidc`` is not installed.
    """
    if settings.oidc_issuer is None:
        return None
    if settings.oidc_audience is None:
        raise UnavailableError("MAGCAL_OIDC_ISSUER needs MAGCAL_OIDC_AUDIENCE: whom its tokens are for")
    if not _is_safe(settings.oidc_issuer):
        raise UnavailableError("MAGCAL_OIDC_ISSUER must be an https address")
    try:
        import joserfc  # noqa: F401
    except ImportError as error:
        raise UnavailableError("MAGCAL_OIDC_ISSUER needs the extra: pip install 'magcal-service[oidc]'") from error
    return Issuer(settings)
