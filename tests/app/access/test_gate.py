"""A crowd at the door: refused with what an honest refusal needs, before access or body are looked at (L4)."""

from __future__ import annotations

import json
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

from tests.app.access.test_limits import CSV, post_slowly, rows, satellite_of, wait_for_uploads

HEAD = (
    "POST /api/v1{} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {}\r\n"
    "Content-Type: text/csv\r\nContent-Length: {}\r\n\r\n"
)


def ask(url: str, path: str, key: str, length: int) -> tuple[int, dict[str, str], dict[str, object]]:
    """Return status, headers and body of the answer to an upload of which only the head is sent."""
    place = urlsplit(url)
    with socket.create_connection((place.hostname, place.port), timeout=10) as connection:
        connection.sendall(HEAD.format(path, key, length).encode())
        answer = connection.makefile("rb")
        status = int(answer.readline().split()[1])
        lines = iter(answer.readline, b"\r\n")
        headers = dict(line.decode().strip().lower().split(": ", 1) for line in lines)
        return status, headers, json.loads(answer.read(int(headers["content-length"])))


def test_a_full_house_refuses_from_the_head_alone_whoever_asks(new_service):
    """503 with Retry-After though not a byte of the body came, and though the key is wrong; other calls go on."""
    service = new_service(max_uploads_per_key=2, max_uploads_at_once=2)
    release = threading.Event()

    def slow(seed: int):
        body = rows(10, seed)
        yield body[:50]
        release.wait(20)
        yield body[50:]

    with service.client() as admin, ThreadPoolExecutor(2) as pool:
        path = satellite_of(admin)
        held = [pool.submit(post_slowly, service, path, slow(seed)) for seed in range(2)]
        wait_for_uploads(service, 2)
        for key, wanted, code in (("wrong", 503, "busy"), (service.admin_key, 429, "quota")):
            for where in (path, "/sessions/none/samples", "/satellites/one/orbits"):
                status, headers, body = ask(service.url, where, key, 1_000_000)
                assert (status, headers["retry-after"]) == (wanted, "1")
                assert headers["content-type"] == "application/problem+json"
                assert {"x-request-id", "content-security-policy"} <= set(headers)
                assert (body["status"], body["code"]) == (wanted, code)
        assert admin.get("/satellites").status_code == 200
        assert admin.get(f"{service.url}/healthz").status_code == 200
        assert 'route="refused at the door"' in admin.get(f"{service.url}/metrics").text
        release.set()
        assert [one.result() for one in held] == [201, 201]
        assert admin.post(path, content=rows(10, 9), headers=CSV).status_code == 201


def test_places_are_free_again_however_an_upload_ended(new_service):
    """Wrong keys, foreign satellites, broken bodies and closed connections leave no place taken."""
    service = new_service(max_uploads_per_key=1, max_uploads_at_once=1)
    with service.client() as admin, service.client("") as nobody:
        path = satellite_of(admin)
        for _ in range(3):
            assert nobody.post(path, content=rows(5), headers=CSV).status_code == 401
            assert (
                admin.post("/satellites/none/sessions?magnetometer=mgm", content=b"x", headers=CSV).status_code == 404
            )
            assert admin.post(path, content=b"no telemetry", headers=CSV).status_code == 422
        assert admin.post(path, content=rows(5), headers=CSV).status_code == 201
