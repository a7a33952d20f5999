"""Connections that say nothing, keys that are right beside wrong ones, text that no database can keep."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest

from app.reporting.figures.page import figure_page, plotly_source

CSV = {"content-type": "text/csv"}
PASS = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"


def connect(service) -> socket.socket:
    where = urlsplit(service.url)
    return socket.create_connection((where.hostname, where.port), timeout=30)


def closed_after(connection: socket.socket) -> tuple[float, bytes]:
    """Return how long it takes until the other side closes, s, and what it said before."""
    begun, said = time.monotonic(), b""
    while piece := connection.recv(1 << 16):
        said += piece
    return time.monotonic() - begun, said


def head(service, method: str, path: str, key: str = "", **headers: str) -> bytes:
    named = {"Host": urlsplit(service.url).netloc, **({"Authorization": f"Bearer {key}"} if key else {}), **headers}
    lines = [f"{method} {path} HTTP/1.1", *(f"{name.replace('_', '-')}: {value}" for name, value in named.items())]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


@pytest.mark.parametrize("case", ["silent", "half a head", "dripping head", "half a JSON body", "half a form"])
def test_a_connection_that_does_not_go_on_is_closed(new_service, case):
    service = new_service(request_timeout_s=1.0)
    with connect(service) as connection:
        if case == "half a head":
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n")
        if case == "dripping head":
            begun = time.monotonic()
            try:
                while time.monotonic() - begun < 10:
                    connection.sendall(b"G")
                    time.sleep(0.1)
            except OSError:
                pass
            assert time.monotonic() - begun < 4
            return
        if case == "half a JSON body":
            connection.sendall(
                head(service, "POST", "/api/v1/satellites", service.admin_key, Content_Type="application/json",
                     Content_Length="100") + b'{"id":'
            )  # fmt: skip
        if case == "half a form":
            connection.sendall(head(service, "POST", "/login", Content_Length="100") + b"key=")
        elapsed_s, said = closed_after(connection)
    assert 0.5 < elapsed_s < 5
    if case.startswith("half a JSON") or case == "half a form":
        assert said.startswith(b"HTTP/1.1 408")
        assert b"upload_stalled" in said


def test_an_answer_that_takes_longer_than_the_silence_is_given_all_the_same(new_service, monkeypatch):
    """A client that waits for its answer is not silent: the limit is for requests that do not come."""
    service = new_service(request_timeout_s=0.5)
    monkeypatch.setattr("app.operations.health.metrics_text", lambda _db: time.sleep(2) or b"late")
    assert httpx2.get(f"{service.url}/metrics", trust_env=False).content == b"late"


def test_three_hundred_silent_connections_cost_nothing(new_service, capfd):
    service = new_service(request_timeout_s=2.0)
    capfd.readouterr()
    silent = [connect(service) for _ in range(300)]
    begun = time.monotonic()
    assert httpx2.get(f"{service.url}/healthz", trust_env=False).status_code == 200
    assert time.monotonic() - begun < 1
    for connection in silent:
        closed_after(connection)
        connection.close()
    deadline = time.monotonic() + 10
    while service.server.server_state.connections:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert len("".join(capfd.readouterr())) < 10_000


def test_connections_past_the_limit_are_told_so(new_service):
    service = new_service(max_connections=5, request_timeout_s=20.0)
    held = [connect(service) for _ in range(5)]
    deadline = time.monotonic() + 10
    while len(service.server.server_state.connections) < 5:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    with connect(service) as sixth:
        sixth.sendall(head(service, "GET", "/healthz"))
        _, said = closed_after(sixth)
    assert said.startswith(b"HTTP/1.1 503")
    assert b"retry-after: 1" in said
    for connection in held:
        connection.close()
    while len(service.server.server_state.connections) >= 5:
        time.sleep(0.01)
    assert httpx2.get(f"{service.url}/healthz", trust_env=False).status_code == 200


def test_a_wrong_key_is_told_before_its_body_is_read(new_service):
    """Of a body of a gigabyte not a byte is sent, and the answer comes; with a right key it is the body's turn."""
    service = new_service(request_timeout_s=5.0)
    bound = service.key("read")
    for key, status in (("", 401), ("mgc_wrong", 401), (bound, 403)):
        for path in (
            "/api/v1/satellites",
            "/api/v1/jobs",
            "/api/v1/keys",
            "/api/v1/satellites/a/sessions?magnetometer=m",
        ):
            with connect(service) as connection:
                sent = {"Content_Type": "application/json", "Content_Length": "1000000"}
                connection.sendall(head(service, "POST", path, key, **sent))
                begun = time.monotonic()
                assert connection.recv(1 << 16).startswith(f"HTTP/1.1 {status}".encode()), path
                assert time.monotonic() - begun < 2


def test_a_right_key_passes_whatever_was_guessed_from_its_address(new_service):
    service = new_service(auth_failures_per_minute=3)
    good = service.key("read")
    wrong = good[:-1] + ("A" if good[-1] != "A" else "B")
    form = {"origin": service.url, "sec-fetch-site": "same-origin"}
    with service.client(wrong) as guessing, service.client(good) as known, service.client("") as browser:
        found = [guessing.get("/satellites") for _ in range(6)]
        assert [one.status_code for one in found] == [401] * 3 + [429] * 3
        assert known.get("/satellites").status_code == 200
        assert browser.post(f"{service.url}/login", data={"key": good}, headers=form).status_code == 303
        refused = browser.post(f"{service.url}/login", data={"key": wrong}, headers=form)
        assert refused.status_code == 429
        assert int(refused.headers["retry-after"]) > 0


def test_a_full_disk_says_when_to_come_again(new_service):
    service = new_service(min_free_mb=1 << 40)
    with service.client() as api:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        answer = api.post("/satellites/a/sessions?magnetometer=m", content=PASS, headers=CSV)
    assert (answer.status_code, answer.json()["code"]) == (507, "storage_full")
    assert int(answer.headers["retry-after"]) > 0


@pytest.mark.parametrize("hosts", [[], ["a", "b"], ["a", "a"]])
def test_a_request_has_one_host(new_service, hosts):
    service = new_service()
    with connect(service) as connection:
        lines = ["GET /healthz HTTP/1.1", *(f"Host: {one}" for one in hosts), "Connection: close"]
        connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        assert closed_after(connection)[1].startswith(b"HTTP/1.1 400")


@contextmanager
def each_database(new_service: Callable[..., object], request: pytest.FixtureRequest) -> Iterator[list[httpx2.Client]]:
    """Yield a client of a service on SQLite and one on PostgreSQL, each with a satellite."""
    services = [new_service(), new_service(database_url=request.getfixturevalue("postgres_url"))]
    clients = [service.client() for service in services]
    for api in clients:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
    try:
        yield clients
    finally:
        for api in clients:
            api.close()


def omm(name: str) -> str:
    return json.dumps(
        {
            "OBJECT_NAME": name, "OBJECT_ID": "1998-067A", "CENTER_NAME": "EARTH", "REF_FRAME": "TEME",
            "TIME_SYSTEM": "UTC", "MEAN_ELEMENT_THEORY": "SGP4", "EPOCH": "2026-01-01T00:00:00.000000",
            "MEAN_MOTION": 15.49, "ECCENTRICITY": 0.0006, "INCLINATION": 51.64, "RA_OF_ASC_NODE": 200.0,
            "ARG_OF_PERICENTER": 90.0, "MEAN_ANOMALY": 10.0, "EPHEMERIS_TYPE": 0, "CLASSIFICATION_TYPE": "U",
            "NORAD_CAT_ID": 25544, "ELEMENT_SET_NO": 999, "REV_AT_EPOCH": 1, "BSTAR": 0.0001, "MEAN_MOTION_DOT": 0.0,
            "MEAN_MOTION_DDOT": 0.0,
        }
    )  # fmt: skip


HOSTILE_TEXT: dict[str, Callable[[httpx2.Client], httpx2.Response]] = {
    "NUL in a name": lambda api: api.post("/satellites", content=b'{"id": "b", "name": "x\\u0000y"}', headers=JSON),
    "half a pair in a name": lambda api: api.post(
        "/satellites", content=b'{"id": "b", "name": "\\ud800"}', headers=JSON
    ),
    "NUL in an option": lambda api: api.post("/reprocessings", content=b'{"field": "\\u0000"}', headers=JSON),
    "NUL in a member": lambda api: api.post("/satellites", content=b'{"id": "b", "\\u0000": 1}', headers=JSON),
    "NUL in a column": lambda api: api.post(
        "/satellites/a/magnetometers", content=b'{"id": "n", "unit": "nT", "columns": {"bx": "\\u0000"}}', headers=JSON
    ),
    "NUL in a path": lambda api: api.get("/sessions/%00"),
    "NUL in a query": lambda api: api.get("/jobs?kind=%00"),
    "NUL in a header of a table": lambda api: api.post(
        "/satellites/a/sessions?magnetometer=m", content=PASS.replace("ref_b", "ref_b,t\0").replace("0\n", "0,1\n"),
        headers=CSV,
    ),
    "NUL in an orbit's name": lambda api: api.post("/satellites/a/orbits", content=omm("A\0B"), headers=JSON),
    "a name of 300 characters": lambda api: api.post("/satellites", json={"id": "b", "name": "x" * 300}),
    "a magnetometer of 100 characters": lambda api: api.post(
        "/satellites/a/magnetometers", json={"id": "n" * 100, "unit": "nT"}
    ),
}  # fmt: skip
JSON = {"content-type": "application/json"}


@pytest.mark.postgres
def test_text_that_no_database_can_keep_is_refused_by_both_alike(new_service, request):
    with each_database(new_service, request) as clients:
        for name, ask in HOSTILE_TEXT.items():
            on_sqlite, on_postgres = (ask(api) for api in clients)
            assert on_sqlite.status_code in {400, 404, 422}, (name, on_sqlite.text)
            assert (on_sqlite.status_code, on_sqlite.json()["code"]) == (
                on_postgres.status_code,
                on_postgres.json()["code"],
            ), name


@pytest.mark.postgres
def test_reprocessings_obey_the_queue_s_limit_and_audit_pages(new_service):
    service = new_service(max_queued_jobs=2)
    with service.client() as api:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        for second in range(3):
            sent = PASS.replace("20000,1", f"20000,{second}")
            api.post("/satellites/a/sessions?magnetometer=m", content=sent, headers=CSV).raise_for_status()
        answer = api.post("/reprocessings", json={"satellites": ["a"]})
        assert (answer.status_code, answer.json()["code"]) == (429, "quota")
        assert "retry-after" in answer.headers
        assert api.get("/jobs").json()["items"] == []
        seen, cursor = [], None
        while True:
            page = api.get("/audit", params={"limit": 2, **({"cursor": cursor} if cursor else {})}).json()
            seen += [one["id"] for one in page["items"]]
            if (cursor := page["next"]) is None:
                break
        assert len(seen) == len(set(seen)) == len(api.get("/audit", params={"limit": 100}).json()["items"]) >= 6


def test_metrics_answer_without_the_database(new_service):
    service = new_service()
    (service.settings.data_dir / "magcal.db").rename(service.settings.data_dir / "gone.db")
    (service.settings.data_dir / "magcal.db").mkdir()  # nothing that could be opened
    service.database.close()  # whoever has it open still, as threads beside requests may
    answer = httpx2.get(f"{service.url}/metrics", trust_env=False)
    assert answer.status_code == 200
    assert "magcal_database_up 0.0" in answer.text
    assert "magcal_request_seconds" in answer.text


def test_no_figure_has_a_way_out(tmp_path: Path):
    import plotly.graph_objects as go

    page = figure_page("t", {"one": go.Figure(go.Scatter(x=[1], y=[2]))})
    for text in (page, plotly_source()):
        for way in ("Share chart", "Plotly Cloud", "cloud.plotly.com", 'showSendToCloud:{valType:"boolean",dflt:!0}'):
            assert way not in text
    assert 'http-equiv="Content-Security-Policy"' in page
