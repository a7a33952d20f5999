"""Pages and login: nothing without a key, nothing for other sites, nothing from elsewhere."""

import gzip
import html
import json
import re
import time
from collections.abc import Callable, Iterator
from importlib import resources

import httpx2
import pytest

from app.dashboard.assets import plotly_version

PAGES = [
    "/", "/satellites/any", "/satellites/any/magnetometers", "/satellites/any/magnetometers/mgm", "/sessions/any",
    "/parameter-sets/any", "/jobs", "/reprocessings", "/reprocessings/any", "/keys", "/compare", "/reasons",
]  # fmt: skip
SAME_ORIGIN = {"Sec-Fetch-Site": "same-origin"}
ASSET = f"/assets/plotly-{plotly_version()}.min.js"
PATIENCE_S = 120.0
STATIC = {path.name: path.read_text() for path in (resources.files("app.dashboard") / "static").iterdir()}


@pytest.fixture
def visitor(service) -> Iterator[httpx2.Client]:
    """A browser without a login."""
    with httpx2.Client(base_url=service.url, timeout=60.0, trust_env=False) as client:
        yield client


def sign_in(visitor: httpx2.Client, key: str, target: str = "/", **headers: str) -> httpx2.Response:
    return visitor.post("/login", data={"key": key, "target": target}, headers=SAME_ORIGIN | headers)


@pytest.mark.parametrize("page", PAGES)
def test_without_a_login_every_page_is_the_sign_in_form(visitor, page):
    answer = visitor.get(page)
    assert answer.status_code == 200
    assert '<form method="post" action="/login"' in answer.text
    assert f'name="target" value="{page}"' in answer.text
    assert answer.headers["cache-control"] == "no-store"


def test_signing_in_gives_a_cookie_that_scripts_and_other_sites_cannot_use(visitor, service):
    answer = sign_in(visitor, service.admin_key, "/jobs")
    assert (answer.status_code, answer.headers["location"]) == (303, "/jobs")
    flags = {part.strip().lower() for part in answer.headers["set-cookie"].split(";")[1:]}
    assert {"httponly", "samesite=strict", "path=/", "max-age=43200"} <= flags
    assert service.admin_key not in answer.headers["set-cookie"]
    assert 'data-scopes="admin"' in visitor.get("/jobs").text


def test_the_cookie_reads_and_changes_only_from_the_own_pages(visitor, service, names):
    sign_in(visitor, service.admin_key)
    host = service.url.removeprefix("http://")
    assert visitor.get("/api/v1/satellites").status_code == 200
    refused = [{}, {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "same-site"}, {"Origin": "http://evil.example"}]
    for headers in [*refused, {"Origin": "null"}, SAME_ORIGIN | {"Sec-Fetch-Site": "none"}]:
        answer = visitor.post("/api/v1/satellites", json={"id": next(names)}, headers=headers)
        assert answer.status_code == 401, headers
    for headers in [SAME_ORIGIN, {"Origin": f"http://{host}"}]:
        assert visitor.post("/api/v1/satellites", json={"id": next(names)}, headers=headers).status_code == 201


def test_a_wrong_key_signs_nobody_in(visitor, service):
    for key in ["", "mgc_wrong", service.admin_key[:-1] + ("A" if service.admin_key[-1] != "A" else "B")]:
        answer = sign_in(visitor, key)
        assert answer.status_code == 403
        assert "set-cookie" not in answer.headers
        assert "not a valid key" in answer.text


def test_wrong_keys_are_limited_as_they_are_in_the_api(new_service: Callable):
    limited = new_service(auth_failures_per_minute=3)
    with httpx2.Client(base_url=limited.url, trust_env=False) as visitor:
        answers = [sign_in(visitor, "mgc_wrong").status_code for _ in range(5)]
    assert answers == [403, 403, 403, 429, 429]


def test_another_site_cannot_sign_a_browser_in(visitor, service):
    answer = visitor.post("/login", data={"key": service.admin_key}, headers={"Sec-Fetch-Site": "cross-site"})
    assert answer.status_code == 403
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize("target", ["//evil.example", "https://evil.example", "/\\evil.example", "/a\r\nb", "evil"])
def test_signing_in_leads_only_to_own_pages(visitor, service, target):
    assert sign_in(visitor, service.admin_key, target).headers["location"] == "/"


def test_signing_out_ends_the_login_on_the_server_too(visitor, service):
    sign_in(visitor, service.admin_key)
    cookies = dict(visitor.cookies)
    assert visitor.get("/login/state").json() == {"signed_in": True}
    visitor.post("/logout", headers=SAME_ORIGIN)
    visitor.cookies.update(cookies)
    assert visitor.get("/login/state").json() == {"signed_in": False}
    assert visitor.get("/api/v1/satellites").status_code == 401


def test_a_login_ends_with_its_key(visitor, service, api):
    key = service.key("read")
    sign_in(visitor, key)
    assert visitor.get("/login/state").json() == {"signed_in": True}
    api.post(f"/keys/{key.split('_')[1]}/revoke").raise_for_status()
    assert visitor.get("/login/state").json() == {"signed_in": False}


def test_a_huge_form_is_no_login(visitor):
    assert visitor.post("/login", data={"key": "x" * 100_000}, headers=SAME_ORIGIN).status_code == 403


@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_no_script_inside_and_names_no_other_host(visitor, service, page):
    sign_in(visitor, service.admin_key)
    answer = visitor.get(page)
    policy = dict(part.strip().split(" ", 1) for part in answer.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert re.findall(r"<script(?![^>]*(?:\bsrc=|type=\"application/json\"))", answer.text) == []
    assert re.findall(r"\son[a-z]+=", answer.text) == []
    assert re.findall(r"(?:https?:)?//[a-z]", answer.text) == []


def test_text_in_an_address_cannot_become_markup(visitor, service):
    sign_in(visitor, service.admin_key)
    answer = visitor.get("/satellites/%3Cimg%20src=x%20onerror=alert(1)%3E")
    assert "<img" not in answer.text


def version_of_files(visitor: httpx2.Client) -> str:
    return re.findall(r"/static/(\w+)/theme\.js", visitor.get("/").text)[0]


@pytest.mark.parametrize("name", STATIC)
def test_a_file_of_the_dashboard_is_kept_under_the_address_of_its_version(visitor, name):
    address = f"/static/{version_of_files(visitor)}/{name}"
    first = visitor.get(address)
    assert (first.status_code, first.text) == (200, STATIC[name])
    assert first.headers["cache-control"] == "public, max-age=31536000, immutable"
    again = visitor.get(address, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_a_page_of_another_version_gets_files_that_are_not_kept(visitor):
    answer = visitor.get("/static/0000000000000000/style.css")
    assert (answer.text, answer.headers["cache-control"]) == (STATIC["style.css"], "no-cache")


@pytest.mark.parametrize("page", PAGES)
def test_a_page_names_every_module_that_it_will_import(visitor, service, page):
    """Modules that are named are loaded side by side; else each waits for the one that imports it."""
    sign_in(visitor, service.admin_key)
    text = visitor.get(page).text
    named = set(re.findall(r'rel="modulepreload" href="/static/\w+/([\w.]+)"', text))
    (script,) = re.findall(r'<script type="module" src="/static/\w+/([\w.]+)"', text)
    wanted = {script, *named}
    imported = {name for one in wanted for name in re.findall(r'from "\./([\w.]+)"', STATIC[one])}
    assert imported - {script} == named


def brought(page: str) -> dict[str, object]:
    """Return the answers that a page brings along."""
    found = re.findall(r'<script type="application/json" data-answer="([^"]+)">(.*?)</script>', page)
    return {html.unescape(path): json.loads(text) for path, text in found}


@pytest.fixture
def shown(mission) -> dict[str, set[str]]:
    """Page -> paths of the API whose answers it brings along."""
    satellite, session, sets = mission.satellite, mission.session, (mission.first, mission.second)
    return {
        "/": {"/attention?limit=100&total=true", "/fleet?limit=50&sort=worst", "/fleet?limit=1"},
        f"/satellites/{satellite}": {f"/satellites/{satellite}", f"/overview?satellite={satellite}"},
        f"/sessions/{session}": {f"/sessions/{session}", f"/jobs?kind=calibration&limit=1&session={session}"},
        f"/parameter-sets/{sets[0]}": {f"/parameter-sets/{sets[0]}"},
        f"/compare?first={sets[0]}&second={sets[1]}": {f"/parameter-sets/{one}" for one in sets},
        "/jobs": {"/jobs?limit=50&sort=-created&total=true"},
        "/keys": {"/keys?limit=1000"},
        "/reprocessings": {"/jobs?kind=reprocessing&limit=50&sort=-created&total=true"},
        f"/satellites/{satellite}/magnetometers": {f"/satellites/{satellite}", f"/overview?satellite={satellite}"},
    }


@pytest.fixture
def at_rest(api) -> None:
    """Wait until no job waits or runs, and what has ended is told: nothing then changes but by the test itself."""
    deadline, seen = time.monotonic() + PATIENCE_S, None
    while True:
        counts = api.get("/jobs", params={"limit": 1, "total": "true"}).json()["counts"]
        attention = api.get("/attention", params={"limit": 1}).json()["counts"]
        if not counts.get("queued") and not counts.get("running") and seen == (counts, attention):
            return
        seen = (counts, attention)
        assert time.monotonic() < deadline, counts
        time.sleep(0.5)


@pytest.mark.usefixtures("at_rest")
def test_what_a_page_brings_along_is_what_the_api_answers(visitor, service, api, shown):
    """Of the page or of the page again: what only time makes so may change between it and the API once."""
    sign_in(visitor, service.admin_key)
    for page, paths in shown.items():
        for is_last in (False, True):
            found = brought(visitor.get(page).text)
            assert set(found) == paths
            answers = {path: api.get(path).raise_for_status().json() for path in found}
            if found == answers:
                break
            assert not is_last, [path for path in found if found[path] != answers[path]]


def test_a_page_brings_along_only_what_the_key_may_see(visitor, service, api, shown, names):
    other = next(names)
    api.post("/satellites", json={"id": other}).raise_for_status()
    own = {}
    for key in (service.key("ingest"), service.key("read", satellites=[other])):
        sign_in(visitor, key)
        own[key] = [brought(visitor.get(page).text) for page in shown]
    blind, bound = own.values()
    assert not any(blind)
    assert {row["satellite"] for row in bound[0]["/fleet?limit=50&sort=worst"]["items"]} <= {other}
    assert bound[1:5] == [{}] * 4
    assert bound[5]["/jobs?limit=50&sort=-created&total=true"]["items"] == []
    assert bound[6] == {} and bound[8] == {}
    assert bound[7]["/jobs?kind=reprocessing&limit=50&sort=-created&total=true"]["items"] == []


def test_what_a_page_brings_along_cannot_become_markup(visitor, service, api, names):
    satellite = next(names)
    name = "</script><img src=x onerror=alert(1)>"
    api.post("/satellites", json={"id": satellite, "name": name}).raise_for_status()
    sign_in(visitor, service.admin_key)
    text = visitor.get(f"/satellites/{satellite}").text
    assert "<img" not in text
    assert brought(text)[f"/satellites/{satellite}"]["name"] == name


def test_the_dashboard_s_own_code_names_no_other_host():
    for name, text in STATIC.items():
        addresses = set(re.findall(r"https?://[^\"'\s)]+", text)) - {"http://www.w3.org/2000/svg"}
        assert addresses == set(), name


def test_every_module_that_is_imported_is_there():
    for text in STATIC.values():
        for name in re.findall(r'from "\./([\w.]+)"', text):
            assert name in STATIC


@pytest.mark.parametrize(
    ("name", "status"), [("missing.js", 404), ("..%2fpages.py", 404), ("%2e%2e/pages.py", 404), ("style.css%00", 400)]
)
def test_what_is_no_file_of_the_dashboard_is_not_served(visitor, name, status):
    """A NUL is refused at the door, before anything is looked for."""
    assert visitor.get(f"/static/{version_of_files(visitor)}/{name}").status_code == status


def test_the_plot_library_is_packed_kept_for_a_year_and_known_again(visitor):
    packed = visitor.get(ASSET)
    assert packed.headers["content-encoding"] == "gzip"
    assert "max-age=31536000" in packed.headers["cache-control"]
    plain = visitor.get(ASSET, headers={"Accept-Encoding": "identity"})
    assert plain.content == packed.content
    assert len(gzip.compress(plain.content, 6)) < 2_000_000
    again = visitor.get(ASSET, headers={"If-None-Match": packed.headers["etag"]})
    assert again.status_code == 304
    assert visitor.get("/assets/plotly-0.0.0.min.js").status_code == 404
