"""Pages of other origins: those that are listed may call the API with a key, no other one, and none with the cookie."""

import httpx2

ALLOWED = "https://ops.example.org"
ASKED = {"Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "authorization"}


def preflight(service, origin: str) -> httpx2.Response:
    path = f"{service.url}/api/v1/attention"
    return httpx2.request("OPTIONS", path, headers={"Origin": origin, **ASKED}, trust_env=False)


def test_listed_origins_may_call_and_others_may_not(new_service):
    service = new_service(cors_origins=f"{ALLOWED}/, http://localhost:5173")
    answer = preflight(service, ALLOWED)
    assert answer.status_code == 200
    assert answer.headers["access-control-allow-origin"] == ALLOWED
    assert "authorization" in answer.headers["access-control-allow-headers"].lower()
    assert "access-control-allow-credentials" not in answer.headers
    assert "access-control-allow-origin" not in preflight(service, "https://evil.example.org").headers
    with service.client() as api:
        read = api.get("/attention", headers={"Origin": ALLOWED})
        assert read.headers["access-control-allow-origin"] == ALLOWED
        assert "access-control-allow-origin" not in api.get("/attention", headers={"Origin": "https://a.org"}).headers


def test_no_origin_may_call_unless_listed(service):
    assert "access-control-allow-origin" not in preflight(service, ALLOWED).headers


def test_an_unknown_address_is_a_page_for_a_browser_and_a_problem_for_a_program(service):
    page = httpx2.get(f"{service.url}/nowhere", headers={"Accept": "text/html"}, trust_env=False)
    assert page.headers["content-type"] == "text/html; charset=utf-8"  # who is not signed in signs in first
    plain = httpx2.get(f"{service.url}/nowhere", trust_env=False)
    assert (plain.status_code, plain.json()["code"]) == (404, "not_found")
    api = httpx2.get(f"{service.url}/api/v1/nowhere", headers={"Accept": "text/html"}, trust_env=False)
    assert api.headers["content-type"] == "application/problem+json"
