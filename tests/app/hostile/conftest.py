"""How hostile input is sent, and what holds for every refusal."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import httpx2
import pytest

CSV = {"content-type": "text/csv"}
ENDED = {"succeeded", "failed", "cancelled"}


def refused(answer: httpx2.Response, status: int, code: str) -> dict:
    """Return the problem after checking that it is one: its form, and nothing of the program's inside."""
    body = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    assert (answer.status_code, body["status"], body["code"]) == (status, status, code), body
    assert {"type", "title", "detail"} <= set(body)
    assert "Traceback" not in answer.text
    assert "site-packages" not in answer.text
    return body


@pytest.fixture(scope="session")
def check() -> Callable[..., dict]:
    """Check a refusal and return its problem."""
    return refused


@pytest.fixture
def send(api, satellite) -> Callable[..., httpx2.Response]:
    """Send telemetry of the magnetometer ``mgm``."""

    def post(content: bytes | str, **headers: str) -> httpx2.Response:
        body = content.encode() if isinstance(content, str) else content
        named = CSV | {name.replace("_", "-"): value for name, value in headers.items()}
        return api.post(f"/satellites/{satellite}/sessions?magnetometer=mgm", content=body, headers=named)

    return post


@pytest.fixture
def send_orbit(api, satellite) -> Callable[..., httpx2.Response]:
    """Send an orbit message."""

    def post(content: bytes | str, content_type: str = "text/plain") -> httpx2.Response:
        body = content.encode() if isinstance(content, str) else content
        return api.post(f"/satellites/{satellite}/orbits", content=body, headers={"content-type": content_type})

    return post


@pytest.fixture
def finished(api) -> Callable[..., dict]:
    """Ask for a calibration and return the job once it has ended."""

    def run(session_id: str, **options: object) -> dict:
        asked = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id], **options})
        assert asked.status_code == 202, asked.text
        deadline = time.monotonic() + 90
        while (job := api.get(asked.headers["location"].removeprefix("/api/v1")).json())["state"] not in ENDED:
            assert time.monotonic() < deadline, job
            time.sleep(0.05)
        return job

    return run


@pytest.fixture
def raw(service) -> Callable[[bytes], bytes]:
    """Send bytes to the port and return what comes back until the server closes or falls silent."""
    address = ("127.0.0.1", int(service.url.rpartition(":")[2]))

    def exchange(request: bytes, silence_s: float = 5.0) -> bytes:
        answer = b""
        with socket.create_connection(address, timeout=silence_s) as connection:
            try:
                connection.sendall(request)
                while piece := connection.recv(65536):
                    answer += piece
                    if b"\r\n\r\n" in answer and answer.startswith(b"HTTP/1.1 4"):
                        break
            except (TimeoutError, ConnectionError):
                pass
        return answer

    return exchange


@pytest.fixture(autouse=True)
def still_alive(service):
    """Whatever a test sends, the service answers afterwards and leaves no file behind."""
    yield
    with service.client() as admin:
        assert admin.get("/satellites", params={"limit": 1}).status_code == 200
    assert list((service.settings.data_dir / "incoming").iterdir()) == []
