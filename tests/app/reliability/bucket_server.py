"""A small server that speaks as much of S3 as the service asks of it, and fails as it is told to."""

from __future__ import annotations

import hashlib
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

SLOW_S: Final = 0.4
FAULTS: Final = ("500", "503", "reset", "lost", "shortened")
"""What may become of a write. ``lost``: acknowledged and not kept; ``shortened``: acknowledged, kept in part."""
WRONG_READS: Final = ("500", "reset", "truncated", "shortened", "flipped")
"""What may become of a read. ``truncated``: it ends before the length that was announced."""


class Bucket(ThreadingHTTPServer):
    """Objects in memory, and the fault that every request of a method meets."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.objects: dict[str, bytes] = {}
        self.faults: dict[str, str] = {}
        self.requests = 0

    @property
    def url(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: who resets a connection expects that it breaks."""


@contextmanager
def serving_bucket() -> Iterator[Bucket]:
    """Yield a bucket that serves in a thread."""
    server = Bucket()
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Bucket

    def log_message(self, *_arguments: object) -> None:
        """Say nothing."""

    def _key(self) -> str:
        return unquote(urlsplit(self.path).path).removeprefix("/kept/")

    def _fault(self) -> str:
        self.server.requests += 1
        fault = self.server.faults.get(self.command, "")
        if fault == "slow":
            time.sleep(SLOW_S)
        return fault

    def _broken(self, fault: str) -> bool:
        """Answer with a fault that has nothing to do with the object, and return whether it did."""
        if fault == "reset":
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.close()
            self.close_connection = True
        elif fault in {"500", "503"}:
            self._answer(int(fault), b"<Error><Code>InternalError</Code></Error>")
        return fault in {"reset", "500", "503"}

    def _answer(self, status: int, body: bytes = b"", length: int | None = None, tag: bytes = b"") -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        self.send_header("Last-Modified", "Mon, 30 Nov 2026 00:00:00 GMT")
        self.send_header("ETag", f'"{hashlib.md5(tag, usedforsecurity=False).hexdigest()}"')
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_PUT(self) -> None:
        content = self.rfile.read(int(self.headers["Content-Length"]))
        fault = self._fault()
        if self._broken(fault):
            return
        if fault != "lost":
            self.server.objects[self._key()] = content[: len(content) // 2] if fault == "shortened" else content
        self._answer(200, tag=content)

    def do_HEAD(self) -> None:
        if self._broken(self._fault()):
            return
        content = self.server.objects.get(self._key())
        self._answer(404 if content is None else 200, length=len(content or b""), tag=content or b"")

    def do_GET(self) -> None:
        fault = self._fault()
        if self._broken(fault):
            return
        query = parse_qs(urlsplit(self.path).query)
        if "list-type" in query:
            self._answer(200, self._listing(query.get("prefix", [""])[0]))
            return
        content = self.server.objects.get(self._key())
        if content is None:
            self._answer(404, b"<Error><Code>NoSuchKey</Code></Error>")
            return
        half = content[: len(content) // 2]
        wrong = {"truncated": half, "shortened": half, "flipped": bytes([content[0] ^ 1]) + content[1:]}
        body = wrong.get(fault, content)
        self._answer(200, body, len(content) if fault == "truncated" else None, tag=content)
        self.close_connection = fault == "truncated"

    def do_DELETE(self) -> None:
        if not self._broken(self._fault()):
            self.server.objects.pop(self._key(), None)
            self._answer(204)

    def _listing(self, prefix: str) -> bytes:
        found = "".join(
            f"<Contents><Key>{escape(key)}</Key><Size>{len(content)}</Size><ETag>x</ETag>"
            "<LastModified>2026-11-30T00:00:00.000Z</LastModified></Contents>"
            for key, content in sorted(self.server.objects.items())
            if key.startswith(prefix)
        )
        head = '<?xml version="1.0"?><ListBucketResult xmlns="http://s3.amazonaws.com/doc/2006-03-01/">'
        return f"{head}<IsTruncated>false</IsTruncated>{found}</ListBucketResult>".encode()
