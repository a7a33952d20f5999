"""JSON bodies read more strictly than usual: bounded, not too deep, no key twice, no NaN."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator
from typing import Any, Final

from fastapi import HTTPException, Request, Response
from fastapi.routing import APIRoute
from pydantic import JsonValue

from app.http.guards import admit, guards_of
from app.http.services import HttpServices, services_of
from app.http.unkeepable import has_unkeepable
from app.storage.retry import retried_async

MAX_JSON_BYTES: Final = 4 << 20
MAX_DEPTH: Final = 32
SLOWEST_BYTES_S: Final = 1000
CLOSING: Final = {"Connection": "close"}
MAX_MEMBERS: Final = 1000
"""Members of one object; lists may be longer."""


class JsonError(HTTPException):
    """The body is not JSON as this service reads it."""

    code = "json"

    def __init__(self, why: str, position: int = 0) -> None:
        super().__init__(400, f"the body is not valid JSON: {why}, at {position}")


class BodyTooLargeError(HTTPException):
    """The body is larger than a JSON body may be."""

    code = "upload_too_large"

    def __init__(self) -> None:
        super().__init__(413, f"the body is larger than {MAX_JSON_BYTES >> 20} MiB, which is the limit")


class StalledBodyError(HTTPException):
    """The body does not come in time; the connection is closed."""

    code = "upload_stalled"

    def __init__(self, limit_s: float) -> None:
        super().__init__(408, f"the body made no progress for {limit_s:g} s, or came too slowly", CLOSING)


async def in_time(stream: AsyncGenerator[bytes, None], limit_s: float) -> AsyncIterator[bytes]:
    """Yield the pieces of a short body, none of them later than ``limit_s`` behind the one before.

    Raises
    ------
    StalledBodyError
        One is late, or after ``limit_s`` the body comes slower than `SLOWEST_BYTES_S`.
    """
    clock = asyncio.get_running_loop().time
    begun, size = clock(), 0
    while True:
        try:
            async with asyncio.timeout(limit_s):
                piece = await anext(stream)
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise StalledBodyError(limit_s) from None
        size += len(piece)
        elapsed_s = clock() - begun
        if elapsed_s > limit_s and size < SLOWEST_BYTES_S * elapsed_s:
            raise StalledBodyError(limit_s)
        yield piece


class StrictJsonRequest(Request):
    """A request whose JSON is read strictly."""

    async def body(self) -> bytes:
        """Return the body; one larger than `MAX_JSON_BYTES` is refused."""
        if not hasattr(self, "_body"):
            pieces, size = [], 0
            async for piece in in_time(self.stream(), services_of(self.app, HttpServices).settings.request_timeout_s):
                size += len(piece)
                if size > MAX_JSON_BYTES:
                    raise BodyTooLargeError
                pieces.append(piece)
            self._body = b"".join(pieces)
        return self._body

    async def json(self) -> JsonValue:
        """Return the document in the body."""
        if not hasattr(self, "_json"):
            self._json: JsonValue = parse_json(await self.body())
        document: JsonValue = self._json
        return document

    @property
    def is_repeatable(self) -> bool:
        """Whether the request can be handled once more: its body has not been streamed away."""
        return hasattr(self, "_body") or not self._stream_consumed


class StrictJsonRoute(APIRoute):
    """A route that reads JSON strictly, and tries again where its transaction loses against another.

    Whoever may not call it is told so before the body is read.
    """

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the route's handler over strict requests."""
        handler = super().get_route_handler()
        guards = guards_of(self.dependant) if self.body_field is not None else []

        async def handle(request: Request) -> Response:
            strict = StrictJsonRequest(request.scope, request.receive)
            await admit(strict, guards)
            return await retried_async(lambda: handler(strict), lambda: strict.is_repeatable)

        return handle


def parse_json(content: bytes) -> JsonValue:
    """Return the JSON document in ``content``.

    Raises
    ------
    JsonError
        It is not JSON, is nested deeper than `MAX_DEPTH`, has an object of more than `MAX_MEMBERS` members or with a
        key twice, or a number that is not finite.
    """
    try:
        document: JsonValue = json.loads(
            content.decode("utf-8"), object_pairs_hook=_object, parse_constant=_refuse_constant, parse_float=_finite
        )
    except UnicodeDecodeError as error:
        raise JsonError("it is not UTF-8", error.start) from None
    except json.JSONDecodeError as error:
        raise JsonError(error.msg, error.pos) from None
    except _NotStrictError as error:
        raise JsonError(str(error)) from None
    except (RecursionError, ValueError):
        raise JsonError("it is nested too deep or has a number that is too long") from None
    if _depth(document) > MAX_DEPTH:
        raise JsonError(f"it is nested deeper than {MAX_DEPTH}")
    if any(has_unkeepable(text) for text in _texts(document)):
        raise JsonError("a text has a NUL or half of a surrogate pair")
    return document


class _NotStrictError(ValueError):
    """JSON that Python reads and we do not."""


def _object(pairs: list[tuple[str, JsonValue]]) -> dict[str, JsonValue]:
    if len(pairs) > MAX_MEMBERS:
        raise _NotStrictError(f"an object has more than {MAX_MEMBERS} members")
    found = dict(pairs)
    if len(found) != len(pairs):
        raise _NotStrictError("a key stands twice in one object")
    return found


def _refuse_constant(name: str) -> float:
    raise _NotStrictError(f"{name} is not JSON")


def _finite(text: str) -> float:
    value = float(text)
    if abs(value) == float("inf"):
        raise _NotStrictError("a number is out of range")
    return value


def _texts(document: JsonValue) -> Iterator[str]:
    """Yield every text of a document, the names of members too, without recursion."""
    waiting: list[JsonValue] = [document]
    while waiting:
        one = waiting.pop()
        if isinstance(one, str):
            yield one
        elif isinstance(one, dict):
            yield from one
            waiting.extend(one.values())
        elif isinstance(one, list):
            waiting.extend(one)


def _depth(document: JsonValue) -> int:
    """Return how deep lists and objects are nested, without recursion."""
    level: list[JsonValue] = [document]
    depth = 0
    while level:
        depth += 1
        inner: list[JsonValue] = []
        for one in level:
            inner.extend(one.values() if isinstance(one, dict) else one if isinstance(one, list) else ())
        level = inner
    return depth - 1
