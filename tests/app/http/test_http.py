"""What holds for every call: errors, health, figures, documentation, headers."""

from datetime import datetime

import httpx2
import ppigrf
import pytest


@pytest.fixture
def root(service):
    with httpx2.Client(base_url=service.url, trust_env=False) as client:
        yield client


def test_the_service_is_alive_and_ready(root):
    assert root.get("/healthz").json() == {"status": "ok"}
    ready = root.get("/readyz")
    parts = ("status", "database", "store", "queue", "disk", "kernels", "sources")
    assert (ready.status_code, ready.json()) == (200, dict.fromkeys(parts, "ok"))


def test_prometheus_is_told_of_requests_and_of_the_queue(root):
    text = root.get("/metrics").text
    for name in ("magcal_request_seconds_count", "magcal_queue_age_seconds", "magcal_store_bytes"):
        assert name in text


def test_the_documentation_comes_from_this_machine_alone(root):
    page = root.get("/docs")
    assert page.status_code == 200
    assert "http://" not in page.text.replace(str(root.base_url), "")
    assert "https://" not in page.text
    assert root.get("/static-offline-docs/swagger-ui-bundle.js").status_code == 200


def test_paths_and_methods_that_are_not_there_are_problems(root):
    for answer, code in ((root.get("/api/v2/satellites"), 404), (root.delete("/api/v1/satellites"), 405)):
        assert (answer.status_code, answer.headers["content-type"]) == (code, "application/problem+json")
        assert answer.json()["status"] == code
    assert root.delete("/api/v1/satellites").headers["allow"]


@pytest.mark.parametrize(
    "path", ["/healthz", "/readyz", "/metrics", "/docs", "/", "/api/v1/satellites", "/api/v1/nothing"]
)
def test_head_answers_as_get_does_without_the_content(root, api, path):
    """Status and headers of GET (RFC 9110, 9.3.2); the figures of /metrics grow by the requests that ask for them."""
    headers = {"authorization": api.headers["authorization"]}
    with httpx2.Client(base_url=root.base_url, headers=headers, trust_env=False) as client:
        got, head = client.get(path), client.head(path)
    assert (head.status_code, head.content) == (got.status_code, b"")
    varies = {"date", "x-request-id", *(["content-length"] if path == "/metrics" else [])}
    assert {k: v for k, v in head.headers.items() if k not in varies} == {
        k: v for k, v in got.headers.items() if k not in varies
    }


def test_head_is_405_where_there_is_no_get_and_needs_the_same_key(root, api):
    assert root.head("/api/v1/satellites").status_code == 401
    refused = api.head("/field")
    assert (refused.status_code, refused.headers["allow"], refused.content) == (405, "POST", b"")


def test_head_of_a_stream_of_events_ends_at_its_headers(new_service):
    """The job waits for ever: only a stream that is not followed ends."""
    service = new_service(workers=0)
    with service.client() as api:
        job = api.post("/jobs", json={"kind": "attitude-simulation", "duration_s": 600}).json()
        for _ in range(2):
            answer = api.head(f"/jobs/{job['id']}/events", timeout=20)
            assert answer.status_code == 200
            assert answer.headers["content-type"].startswith("text/event-stream")
        assert api.get(f"/jobs/{job['id']}").json()["state"] == "queued"


def test_browsers_are_told_to_do_no_more_than_asked(root):
    headers = root.get("/api/v1/satellites").headers
    assert headers["x-content-type-options"] == "nosniff"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["cache-control"] == "no-store"
    assert "server" not in headers


def test_a_request_keeps_the_id_that_it_came_with(root):
    assert root.get("/healthz", headers={"x-request-id": "pass-17"}).headers["x-request-id"] == "pass-17"
    assert (
        root.get("/healthz", headers={"x-request-id": "bad id\u00ff".encode("latin-1")}).headers["x-request-id"]
        != "bad"
    )


def test_the_field_is_computed_in_the_frame_of_the_position(api):
    """IGRF-14 by an independent implementation (ppigrf) at 6771.2 km above the equator, 2026-01-01."""
    body = {"time": ["2026-01-01T00:00:00Z"], "position_km": [[6771.2, 0.0, 0.0]], "frame": "ITRF", "model": "igrf-14"}
    answer = api.post("/field", json=body)
    assert answer.status_code == 200, answer.text
    field = answer.json()
    assert field["model"] == "igrf-14"
    new_year = datetime(2026, 1, 1)  # noqa: DTZ001  ppigrf knows no zones
    radial, south, east = ppigrf.igrf_gc(6771.2, 90.0, 0.0, new_year)
    want = [radial.item(), east.item(), -south.item()]
    assert field["field_nt"][0] == pytest.approx(want, abs=0.01)
    inertial = api.post("/field", json=body | {"frame": "GCRF"}).json()
    assert inertial["frame"] == "GCRF"


def test_places_and_times_outside_the_model_are_refused(api):
    body = {"time": ["1700-01-01T00:00:00Z"], "position_km": [[6771.2, 0, 0]], "frame": "ITRF", "model": "igrf"}
    refused = api.post("/field", json=body)
    assert (refused.status_code, refused.json()["code"]) == (422, "model_range")
    lengths = api.post("/field", json=body | {"position_km": []})
    assert lengths.status_code == 422
    naive = api.post("/field", json=body | {"time": ["2026-01-01T00:00:00"]})
    assert naive.json()["code"] == "time_zone_missing"
