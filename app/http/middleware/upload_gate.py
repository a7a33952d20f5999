"""Uploads beyond what may be in flight, answered at the door: before routing, access, log and body cost anything.

What a crowd must be told is the same for all of it, so the answers are made once. `app.http.receiving.Admission`
counts again behind the door, by key and not by what was sent as one.
"""

from __future__ import annotations

import json
import re
import secrets
from collections import Counter
from typing import Final

from starlette.types import ASGIApp, Receive, Scope, Send

from app.http.middleware.security_headers import POLICY
from app.metrics import REQUEST_SECONDS
from app.problems import problem

UPLOADS: Final = re.compile(r"/api/v1/(?:satellites/[^/]+/(?:sessions(?:/preview)?|orbits)|sessions/[^/]+/samples)")
ROUTE: Final = "refused at the door"
"""What the metrics call these requests; the log leaves them out, for a crowd would fill it."""
Headers = list[tuple[bytes, bytes]]


class UploadGate:
    """Answers 503 where ``most`` uploads are in flight, 429 where ``most_per_key`` are with the same credentials."""

    def __init__(self, app: ASGIApp, most: int, most_per_key: int) -> None:
        self._app = app
        self._most = most
        self._most_per_key = most_per_key
        self._in_flight: Counter[bytes] = Counter()
        self._busy = _Refusal(503, "busy", f"{most} uploads are in flight, which is the limit; try again")
        what = f"uploads in flight of this key: {most_per_key}, and the limit is {most_per_key}"
        limits = {"RateLimit-Limit": str(most_per_key), "RateLimit-Remaining": "0", "RateLimit-Reset": "1"}
        self._quota = _Refusal(429, "quota", what, limits)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http" or scope["method"] != "POST" or not UPLOADS.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return
        credentials = _credentials(scope["headers"])
        if self._in_flight[credentials] >= self._most_per_key:
            await self._quota.send(send)
        elif self._in_flight.total() >= self._most:
            await self._busy.send(send)
        else:
            await self._pass(credentials, scope, receive, send)

    async def _pass(self, credentials: bytes, scope: Scope, receive: Receive, send: Send) -> None:
        self._in_flight[credentials] += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._in_flight[credentials] -= 1
            if not self._in_flight[credentials]:
                del self._in_flight[credentials]


def _credentials(headers: Headers) -> bytes:
    """Return what a request identifies itself with, right or not; a login's cookie counts with those of no key."""
    return next((value for name, value in headers if name == b"authorization"), b"")


class _Refusal:
    """One answer, made before it is needed."""

    def __init__(self, status: int, code: str, detail: str, headers: dict[str, str] | None = None) -> None:
        self._status = status
        self._body = json.dumps(problem(status, code, detail)).encode()
        told = {
            "Content-Type": "application/problem+json",
            "Content-Length": str(len(self._body)),
            "Retry-After": "1",
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Content-Security-Policy": POLICY,
        }
        self._headers = [(name.lower().encode(), value.encode()) for name, value in (told | (headers or {})).items()]
        self._count = REQUEST_SECONDS.labels("POST", ROUTE, str(status))

    async def send(self, send: Send) -> None:
        """Answer; the body of the request is left where it is."""
        headers = [*self._headers, (b"x-request-id", secrets.token_hex(8).encode())]
        await send({"type": "http.response.start", "status": self._status, "headers": headers})
        await send({"type": "http.response.body", "body": self._body})
        self._count.observe(0.0)
