"""A receiver of webhooks on loopback, which may be down, refuse, redirect or dawdle; and events to send to it."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from standardwebhooks import Webhook as Verifier

from app.outbox.events import attention_changed
from app.outbox.log import append
from app.storage.database import Database


class Receiver:
    """Takes webhooks at a port that stays its own while it is down."""

    def __init__(self) -> None:
        self.received: list[tuple[dict[str, str], bytes]] = []
        self.answer: Callable[[dict[str, object]], tuple[int, dict[str, str]]] = lambda _body: (204, {})
        self.port = 0
        self._server: ThreadingHTTPServer | None = None
        self.up()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook?a=1"

    def up(self) -> None:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                status, headers = receiver.answer(json.loads(body))
                receiver.received.append(({name.lower(): value for name, value in self.headers.items()}, body))
                self.send_response(status)
                for name, value in {"content-length": "0", **headers}.items():
                    self.send_header(name, value)
                self.end_headers()

            def log_message(self, *_about: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def down(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def bodies(self) -> list[dict]:
        return [json.loads(body) for _, body in self.received]

    def causes(self, magnetometer: str | None = None) -> list[str]:
        data = [one["data"] for one in self.bodies()]
        return [one["cause"] for one in data if magnetometer is None or one["magnetometer"] == magnetometer]

    def verify(self, secret: str) -> None:
        """Check the signature of everything that came, with the specification's own package."""
        for headers, body in self.received:
            Verifier(secret).verify(body, headers)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    running = Receiver()
    yield running
    running.down()


def raise_attention(database: Database, cause: str, magnetometer: str = "mgm") -> None:
    """Have something happen of a magnetometer."""
    event = attention_changed(
        is_raised=True, cause=cause, reason="a reason", satellite_id="sat", magnetometer_id=magnetometer
    )
    with database.write() as session:
        append(session, [event])


def wait_until(is_so: Callable[[], object], longest_s: float = 20.0) -> None:
    deadline = time.monotonic() + longest_s
    while not is_so():
        assert time.monotonic() < deadline, "it did not come to be in time"
        time.sleep(0.02)


@pytest.fixture
def happen() -> Callable[..., None]:
    return raise_attention


@pytest.fixture
def until() -> Callable[..., None]:
    return wait_until
