"""What every answer tells browsers, and what the login lets other sites do: nothing."""

from __future__ import annotations

import httpx2
import pytest

PATHS = [
    "/",
    "/login/state",
    "/docs",
    "/openapi.json",
    "/healthz",
    "/static/0/style.css",
    "/nowhere",
    "/api/v1/satellites",
]


@pytest.fixture
def root(service):
    with httpx2.Client(base_url=service.url, trust_env=False) as client:
        yield client


@pytest.fixture
def signed_in(service, root):
    """A browser that has signed in."""
    answer = root.post("/login", data={"key": service.admin_key}, headers={"origin": service.url})
    assert answer.status_code == 303
    return root


@pytest.mark.parametrize("path", PATHS)
def test_every_answer_forbids_sniffing_framing_and_foreign_content(root, path):
    headers = root.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] in {"no-referrer", "same-origin"}
    policy = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
    assert policy["default-src"] in {"'self'", "'none'"}
    assert (policy["frame-ancestors"], policy["base-uri"]) == ("'none'", "'none'")
    assert "http" not in headers["content-security-policy"]
    assert "server" not in headers
    assert "x-powered-by" not in headers


@pytest.mark.parametrize("path", ["/", "/login/state", "/api/v1/satellites", "/api/v1/keys"])
def test_what_a_login_shows_is_kept_by_no_cache(signed_in, path):
    assert signed_in.get(path).headers["cache-control"] == "no-store"


@pytest.mark.parametrize("path", ["/", "/satellites/x", "/jobs", "/keys"])
def test_pages_run_no_script_but_their_own(root, path):
    policy = root.get(path).headers["content-security-policy"]
    scripts = next(part for part in policy.split(";") if "script-src" in part)
    assert scripts.split() == ["script-src", "'self'"]


def test_no_other_site_is_allowed_to_read_answers(root, service):
    """No CORS: neither for a simple request nor after a preflight."""
    headers = {"origin": "https://evil.example", "access-control-request-method": "POST"}
    for method, path in (("GET", "/api/v1/satellites"), ("OPTIONS", "/api/v1/satellites"), ("GET", "/metrics")):
        answer = root.request(method, path, headers=headers)
        assert not [name for name in answer.headers if name.startswith("access-control-")]


def test_the_login_cookie_is_out_of_reach_of_scripts_and_other_sites(service, root):
    answer = root.post("/login", data={"key": service.admin_key}, headers={"origin": service.url})
    attributes = {part.strip().lower().partition("=")[0] for part in answer.headers["set-cookie"].split(";")}
    assert {"httponly", "samesite", "max-age", "path"} <= attributes
    assert "samesite=strict" in answer.headers["set-cookie"].lower()
    assert service.admin_key not in answer.headers["set-cookie"]


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
        {"sec-fetch-site": "none"},
        {"origin": "http://127.0.0.1.evil.example"},
        {},
    ],
)
def test_a_login_changes_nothing_from_another_site_s_page(signed_in, api, names, headers):
    name = next(names)
    answer = signed_in.post("/api/v1/satellites", json={"id": name}, headers=headers)
    assert answer.status_code == 401
    assert api.get(f"/satellites/{name}").status_code == 404


def test_a_login_changes_things_from_its_own_page_and_not_after_it_has_signed_out(signed_in, service, names):
    headers = {"origin": service.url, "sec-fetch-site": "same-origin"}
    assert signed_in.post("/api/v1/satellites", json={"id": next(names)}, headers=headers).status_code == 201
    cookie = signed_in.cookies["magcal_login"]
    assert signed_in.post("/logout", headers=headers).status_code == 303
    again = httpx2.get(
        f"{service.url}/api/v1/satellites", headers={"cookie": f"magcal_login={cookie}"}, trust_env=False
    )
    assert again.status_code == 401


def test_a_login_ends_with_its_key(service, api, root):
    made = api.post("/keys", json={"scopes": ["read"]}).json()
    root.post("/login", data={"key": made["key"]}, headers={"origin": service.url})
    assert root.get("/api/v1/satellites").status_code == 200
    api.post(f"/keys/{made['id']}/revoke").raise_for_status()
    assert root.get("/api/v1/satellites").status_code == 401


@pytest.mark.parametrize(
    "target", ["https://evil.example", "//evil.example", "/\\evil.example", "javascript:alert(1)", "\t//evil"]
)
def test_the_login_leads_to_no_other_site(service, root, target):
    form = {"key": service.admin_key, "target": target}
    answer = root.post("/login", data=form, headers={"origin": service.url})
    assert (answer.status_code, answer.headers["location"]) == (303, "/")


@pytest.mark.parametrize(
    "text", ["<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "{{1337*7919}}", "${1337*7919}"]
)
def test_text_in_an_address_never_becomes_markup(signed_in, text):
    page = signed_in.get("/satellites/" + httpx2.URL("http://x").copy_with(path=f"/{text}").raw_path.decode()[1:])
    assert text not in page.text or "{" in text
    assert "10587703" not in page.text
