"""Requests whose address or headers are longer than any honest one, refused before anything is done for them."""

from __future__ import annotations

from typing import Final

from starlette.types import ASGIApp, Receive, Scope, Send

from app.http.problem_handlers import problem_response
from app.problems import problem

MOST_ADDRESS_BYTES: Final = 16 << 10
MOST_PARAMETERS: Final = 1000
MOST_HEADER_BYTES: Final = 64 << 10
TOO_LONG: Final = f"the address has more than {MOST_ADDRESS_BYTES >> 10} KiB or {MOST_PARAMETERS} parameters"


class RequestLimits:
    """Answers 414 or 431 where a request's address or headers are too long."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "http":
            query: bytes = scope["query_string"]
            if len(scope["path"]) + len(query) > MOST_ADDRESS_BYTES or query.count(b"&") >= MOST_PARAMETERS:
                body = problem(414, "address_too_long", TOO_LONG)
                await problem_response(body)(scope, receive, send)
                return
            if sum(len(name) + len(value) for name, value in scope["headers"]) > MOST_HEADER_BYTES:
                body = problem(431, "headers_too_long", f"the headers are longer than {MOST_HEADER_BYTES >> 10} KiB")
                await problem_response(body)(scope, receive, send)
                return
        await self._app(scope, receive, send)
