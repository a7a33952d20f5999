"""HTTP/1.1 as the server speaks it: parsed in C, with an end to how long a request's head may grow."""

from __future__ import annotations

from typing import Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

MOST_HEAD_BYTES: Final = 64 << 10


class BoundedHttpProtocol(HttpToolsProtocol):
    """A connection that is refused and closed where the head of a request does not end within `MOST_HEAD_BYTES`.

    A longer head that arrives at once is left to `app.http.middleware.request_limits`, which answers it with the limit.
    """

    _is_in_head = True
    _head_bytes = 0
    _ended = 0

    def data_received(self, data: bytes) -> None:
        """Take what the socket brings; the end of one request and the beginning of the next may come together."""
        was_in_head, ended = self._is_in_head, self._ended
        super().data_received(data)
        if self._is_in_head:
            self._head_bytes += len(data) if was_in_head and ended == self._ended else 0
            if self._head_bytes > MOST_HEAD_BYTES and not self.transport.is_closing():
                self.send_400_response("The request's head is too long.")

    def on_headers_complete(self) -> None:
        """Begin the answer to a request whose head has arrived."""
        self._is_in_head = False
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """End a request; what follows is the head of the next."""
        self._is_in_head, self._head_bytes = True, 0
        self._ended += 1
        super().on_message_complete()
