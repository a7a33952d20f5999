"""HTTP/1.1 as the server speaks it: parsed in C, with an end to how many connections, heads and silences there are."""

from __future__ import annotations

import asyncio
import json
import resource
from typing import Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from app.problems import problem
from app.settings import Settings

MOST_HEAD_BYTES: Final = 64 << 10
FILES_BESIDE: Final = 256
"""Open files that the service needs beside its connections: database, store, bodies on their way in."""
LINGER_S: Final = 1.0
"""A connection past the limit is left open for so long that its client can read why."""


def protocol_of(settings: Settings) -> type[BoundedHttpProtocol]:
    """Return the protocol with the limits of ``settings``, and of the files that this process may open.

    That number is raised as far as the system allows.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = settings.max_connections + FILES_BESIDE
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    most = (
        settings.max_connections
        if soft == resource.RLIM_INFINITY
        else min(settings.max_connections, soft - FILES_BESIDE)
    )

    class LimitedHttpProtocol(BoundedHttpProtocol):
        """The protocol with the limits of these settings."""

        silence_s = settings.request_timeout_s
        most_connections = max(1, most)

    return LimitedHttpProtocol


class BoundedHttpProtocol(HttpToolsProtocol):
    """A connection with an end to what it may take.

    It is closed where the head of a request does not end within `MOST_HEAD_BYTES` or ``silence_s``, or where what is
    left of a body does not come within ``silence_s`` of the answer. A longer head that arrives at once is left to
    `app.http.middleware.request_limits`, which answers it with what it may be.
    Past ``most_connections`` it is answered 503 and closed.
    """

    silence_s: float = 10.0
    most_connections: int = 2000
    _is_in_head = True
    _is_refused = False
    _head_bytes = 0
    _ended = 0
    _patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a new connection, or refuse it where there are too many."""
        self._is_refused = len(self.connections) >= self.most_connections
        super().connection_made(transport)
        if self._is_refused:
            transport.write(_busy(self.most_connections))
            self._wait(LINGER_S)
        else:
            self._wait(self.silence_s)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self._wait(None)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what the socket brings; the end of one request and the beginning of the next may come together."""
        if self._is_refused:
            return
        was_in_head, ended = self._is_in_head, self._ended
        super().data_received(data)
        if self._is_in_head:
            self._head_bytes += len(data) if was_in_head and ended == self._ended else 0
            if self._head_bytes > MOST_HEAD_BYTES and not self.transport.is_closing():
                self.send_400_response("The request's head is too long.")
            elif self._patience is None and (was_in_head or ended != self._ended):
                self._wait(self.silence_s)

    def on_headers_complete(self) -> None:
        """Begin the answer to a request whose head has arrived."""
        self._is_in_head = False
        self._wait(None)
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """End a request; what follows is the head of the next."""
        self._is_in_head, self._head_bytes = True, 0
        self._ended += 1
        self._wait(None)
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """End an answer; what is left of its request's body is read and thrown away, for a while."""
        super().on_response_complete()
        if not self._is_in_head:
            self._wait(self.silence_s)

    def _wait(self, limit_s: float | None) -> None:
        """Close the connection in ``limit_s`` seconds unless something else is said before; None: do not."""
        if self._patience is not None:
            self._patience.cancel()
        self._patience = None if limit_s is None else self.loop.call_later(limit_s, self._close)

    def _close(self) -> None:
        self._patience = None
        if self._is_in_head and self.cycle is not None and not self.cycle.response_complete:
            self._wait(self.silence_s)  # an answer is still due to the request before
        elif not self.transport.is_closing():
            self.transport.close()


def _busy(most: int) -> bytes:
    """Return the whole answer to a connection past the limit."""
    body = json.dumps(problem(503, "busy", f"{most} connections are open, which is the limit; try again")).encode()
    head = (
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\n"
        f"content-length: {len(body)}\r\nretry-after: 1\r\nconnection: close\r\n\r\n"
    )
    return head.encode() + body
