"""Answers that a client has already: entity tags, and 304 in place of the content (RFC 9110, 13).

The same request for such an answer again, while nothing was committed to the database since, is answered from memory.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from fastapi import Request, Response
from pydantic import BaseModel
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.http.services import HttpServices, services_of

UNCHANGED: Final[dict[int | str, dict[str, Any]]] = {304: {"description": "What `If-None-Match` names is still so."}}
API: Final = "/api/"
TOLD_BY: Final = (b"if-none-match", b"authorization", b"cookie", b"accept", b"accept-encoding")
"""Headers that an answer may depend on."""
MOST_BYTES: Final = 32 << 20
LONGEST_BYTES: Final = 12 << 20
"""A history of 1,000 whole parameter sets has 8 MB."""
PIECE_BYTES: Final = 256 << 10
"""What is given to a connection at once; the rest waits here, uncopied, until the client has taken that."""
ENTRY_BYTES: Final = 2048
"""What an answer takes beside its content, about."""


def is_known(request: Request, tag: str) -> bool:
    """Return whether the client has what ``tag`` names."""
    asked = request.headers.get("if-none-match", "")
    return any(one.strip().removeprefix("W/") in {tag, "*"} for one in asked.split(","))


def tagged_json(content: bytes, tag: str) -> Response:
    """Return an answer that its client may keep, as long as it asks each time whether it is still so."""
    return Response(content, media_type="application/json", headers=_headers(tag))


def revalidated(request: Request, answer: BaseModel) -> Response:
    """Return ``answer`` under the tag of its content, or that its client has that already."""
    content = answer.model_dump_json().encode()
    tag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    return unchanged(tag) if is_known(request, tag) else tagged_json(content, tag)


def unchanged(tag: str) -> Response:
    """Return the answer to a client that has what ``tag`` names."""
    return Response(status_code=304, headers=_headers(tag))


def _headers(tag: str) -> Mapping[str, str]:
    return {"ETag": tag, "Cache-Control": "private, no-cache"}


@dataclass(frozen=True, slots=True)
class _Known:
    """An answer of ``seen_s`` of the monotonic clock, with the database as ``revision`` says."""

    revision: int
    seen_s: float
    start: Message
    content: bytes


class Revalidation:
    """Answers a request for what carries an entity tag as a moment ago, where the database has not changed since.

    Whatever could change the answer is a commit, a revoked key too, but for a key's end: so a moment is short.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._known: OrderedDict[tuple[object, ...], _Known] = OrderedDict()
        self._size = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http" or scope["method"] != "GET" or not scope["path"].startswith(API):
            await self._app(scope, receive, send)
            return
        database = services_of(scope["app"], HttpServices).database
        revision, seen_s = database.revision(), time.monotonic()
        if revision is None or sum(name == b"host" for name, _ in scope["headers"]) != 1:
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        which = (scope["path"], scope["query_string"], *map(headers.get, TOLD_BY))
        found = self._known.get(which)
        if found is not None and found.revision == revision and seen_s - found.seen_s < TRUSTED_S:
            await send({**found.start, "headers": list(found.start["headers"])})
            await _send_body(send, found.content)
            return
        await self._app(scope, receive, self._noting(which, revision, seen_s, send))

    def _noting(self, which: tuple[object, ...], revision: int, seen_s: float, send: Send) -> Send:
        """Return ``send`` that keeps an answer with an entity tag, where it is whole and not long."""
        start: Message | None = None

        async def answer(message: Message) -> None:
            nonlocal start
            if message["type"] == "http.response.start":
                is_tagged = any(name == b"etag" for name, _ in message["headers"])
                if is_tagged and message["status"] in {200, 304}:
                    start = {**message, "headers": list(message["headers"])}
            elif message.get("more_body", False):
                start = None
            elif start is not None:
                content: bytes = message.get("body", b"")
                self._note(which, _Known(revision, seen_s, start, content))
                await _send_body(send, content)
                return
            await send(message)

        return answer

    def _note(self, which: tuple[object, ...], known: _Known) -> None:
        if len(known.content) > LONGEST_BYTES:
            return
        before = self._known.pop(which, None)
        self._size += len(known.content) + ENTRY_BYTES - (len(before.content) + ENTRY_BYTES if before else 0)
        self._known[which] = known
        while self._size > MOST_BYTES:
            self._size -= len(self._known.popitem(last=False)[1].content) + ENTRY_BYTES


async def _send_body(send: Send, content: bytes) -> None:
    view = memoryview(content)
    for begin in range(0, max(len(view), 1), PIECE_BYTES):
        end = begin + PIECE_BYTES
        await send({"type": "http.response.body", "body": view[begin:end], "more_body": end < len(view)})


TRUSTED_S: Final = 0.5
