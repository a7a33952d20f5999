"""Who gets in: every call of the OpenAPI document against every kind of key that must not do (A1, A2, A7, A12)."""

from __future__ import annotations

import httpx2
import pytest

OPEN = {"GET /healthz", "GET /readyz", "GET /metrics"}
SCOPES = {
    "POST /satellites": "operate",
    "GET /satellites": "read",
    "GET /satellites/{satellite_id}": "read",
    "PATCH /satellites/{satellite_id}": "operate",
    "POST /satellites/{satellite_id}/magnetometers": "operate",
    "PATCH /satellites/{satellite_id}/magnetometers/{magnetometer_id}": "operate",
    "GET /satellites/{satellite_id}/magnetometers": "read",
    "GET /satellites/{satellite_id}/magnetometers/{magnetometer_id}": "read",
    "GET /satellites/{satellite_id}/magnetometers/{magnetometer_id}/trend": "read",
    "GET /satellites/{satellite_id}/magnetometers/{magnetometer_id}/trend/series": "read",
    "DELETE /satellites/{satellite_id}": "admin",
    "POST /satellites/{satellite_id}/orbits": "ingest operate",
    "GET /satellites/{satellite_id}/orbits": "read",
    "GET /satellites/{satellite_id}/orbits/{orbit_id}": "read",
    "GET /satellites/{satellite_id}/history": "read",
    "GET /satellites/{satellite_id}/figures/{figure}": "read",
    "POST /satellites/{satellite_id}/sessions": "ingest",
    "GET /satellites/{satellite_id}/sessions": "read",
    "POST /satellites/{satellite_id}/sessions/confirm": "ingest",
    "POST /satellites/{satellite_id}/sessions/preview": "ingest",
    "POST /sessions/{session_id}/samples": "ingest",
    "GET /sessions/{session_id}/samples": "read",
    "POST /sessions/{session_id}/close": "ingest",
    "POST /sessions/{session_id}/read-again": "operate",
    "POST /sessions/{session_id}/which-object": "read",
    "GET /sessions": "read",
    "GET /sessions/{session_id}": "read",
    "GET /sessions/{session_id}/summary": "read",
    "GET /sessions/{session_id}/residual": "read",
    "GET /sessions/{session_id}/monitoring": "read",
    "GET /sessions/{session_id}/comparison": "read",
    "GET /sessions/{session_id}/preview": "read",
    "GET /parameter-sets/{parameter_set_id}/comparison": "read",
    "GET /sessions/{session_id}/figures/{figure}": "read",
    "POST /jobs": "operate",
    "POST /reprocessings": "operate",
    "GET /jobs": "read",
    "GET /jobs/{job_id}": "read",
    "GET /jobs/{job_id}/events": "read",
    "GET /jobs/{job_id}/series": "read",
    "POST /jobs/{job_id}/retry": "operate",
    "POST /jobs/{job_id}/cancel": "operate",
    "GET /parameter-sets": "read",
    "GET /parameter-sets/{parameter_set_id}": "read",
    "GET /parameter-sets/{parameter_set_id}/residuals": "read",
    "GET /parameter-sets/{parameter_set_id}/reasons": "read",
    "GET /parameter-sets/{parameter_set_id}/export": "read",
    "GET /parameter-sets/{parameter_set_id}/report": "read",
    "GET /parameter-sets/{parameter_set_id}/pointing": "read",
    "GET /parameter-sets/{parameter_set_id}/refit": "read",
    "GET /parameter-sets/{parameter_set_id}/bias-path": "read",
    "GET /parameter-sets/{parameter_set_id}/rollout": "read",
    "GET /parameter-sets/{parameter_set_id}/figures/{figure}": "read",
    "POST /parameter-sets/{parameter_set_id}/activate": "operate",
    "POST /parameter-sets/{parameter_set_id}/rollback": "operate",
    "POST /parameter-sets/{parameter_set_id}/apply": "read",
    "POST /parameter-sets/{parameter_set_id}/aboard": "operate",
    "GET /parameter-sets/{parameter_set_id}/aboard": "read",
    "GET /figures/compare": "read",
    "GET /overview": "read",
    "GET /attention": "read",
    "POST /attention/{entry_id}/acknowledge": "operate",
    "GET /fleet": "read",
    "POST /satellites/{satellite_id}/orbits/{orbit_id}/withdraw": "operate",
    "POST /satellites/{satellite_id}/orbits/{orbit_id}/restore": "operate",
    "GET /satellites/{satellite_id}/notes": "read",
    "POST /satellites/{satellite_id}/notes": "operate",
    "GET /satellites/{satellite_id}/magnetometers/{magnetometer_id}/notes": "read",
    "POST /satellites/{satellite_id}/magnetometers/{magnetometer_id}/notes": "operate",
    "GET /sessions/{session_id}/notes": "read",
    "POST /sessions/{session_id}/notes": "operate",
    "GET /parameter-sets/{parameter_set_id}/notes": "read",
    "POST /parameter-sets/{parameter_set_id}/notes": "operate",
    "POST /field": "read",
    "POST /indices": "ingest",
    "GET /indices": "read",
    "GET /indices/{index_id}": "read",
    "POST /field-files": "ingest",
    "GET /field-files": "read",
    "GET /field-files/{file_id}": "read",
    "POST /keys": "admin",
    "GET /keys": "admin",
    "POST /keys/{key_id}/revoke": "admin",
    "GET /audit": "admin",
    "GET /events": "read",
    "POST /webhooks": "admin",
    "GET /webhooks": "admin",
    "DELETE /webhooks/{webhook_id}": "admin",
    "GET /webhooks/{webhook_id}/deliveries": "admin",
    "POST /webhooks/{webhook_id}/deliveries/{delivery_id}/replay": "admin",
}
"""Written by hand beside the service: a call that is not here, or has another scope, fails the test."""


def test_every_call_has_the_scope_that_is_written_here(guarded, operations):
    found = {operation.name.replace("/api/v1", ""): " ".join(operation.scopes) for operation in guarded}
    assert found == {name: SCOPES.get(name) for name in found}
    assert {operation.name for operation in operations if operation not in guarded} == OPEN


def test_open_calls_answer_without_a_key(service):
    for name in OPEN:
        assert httpx2.get(f"{service.url}{name.removeprefix('GET ')}", trust_env=False).status_code == 200


def test_no_call_answers_without_a_valid_key_and_all_refusals_are_the_same(world, guarded, anonymous, wrong_keys):
    """The same status, headers and body for every reason, whatever the call, and no word about the thing asked for."""
    bodies, wrong = set(), []
    for operation in guarded:
        for kind, header in {"none": None, **wrong_keys}.items():
            headers = {} if header is None else {b"authorization": header.encode("utf-8")}
            answer = anonymous.request(operation.method, world.url(operation), headers=headers)
            bodies.add(answer.content)
            if answer.status_code != 401 or not answer.headers.get("www-authenticate", "").startswith("Bearer"):
                wrong.append(f"{operation.name}, {kind}: {answer.status_code}")
    assert wrong == []
    assert len(bodies) == 1


def test_a_wrong_key_is_refused_before_the_body_is_read_or_judged(guarded, anonymous, world):
    wrong = []
    for operation in guarded:
        if operation.method == "POST":
            answer = anonymous.request("POST", world.url(operation), content=b"{not json", params={"unknown": "1"})
            if answer.status_code != 401:
                wrong.append(f"{operation.name}: {answer.status_code}")
    assert wrong == []


@pytest.mark.parametrize("scope", ["read", "ingest", "operate"])
def test_a_key_without_the_scope_is_refused_by_name_and_changes_nothing(service, world, guarded, scope):
    """Also with a sound request and for the key's own satellite."""
    wrong = []
    with service.client(service.key(scope, satellites=[world.satellite])) as client:
        for operation in guarded:
            if scope in operation.scopes:
                continue
            answer = client.request(operation.method, world.url(operation), **world.request(operation))
            body = answer.json()
            named = all(one in body.get("detail", "") for one in operation.scopes)
            if (answer.status_code, body.get("code")) != (403, "scope_required") or not named:
                wrong.append(f"{operation.name}: {answer.status_code} {body}")
    assert wrong == []


@pytest.mark.parametrize("scope", ["read", "ingest", "operate"])
def test_a_key_with_the_scope_is_not_refused_for_its_key(service, world, guarded, scope):
    """With no body, so that nothing changes; a scope is checked before the body is judged."""
    with service.client(service.key(scope)) as client, service.client() as admin:
        for operation in guarded:
            if scope in operation.scopes and not operation.path.endswith("/events"):
                answer = client.request(operation.method, world.url(operation))
                assert answer.status_code not in {401, 403, 500}, operation.name
                if answer.status_code == 404:
                    assert admin.request(operation.method, world.url(operation)).status_code == 404, operation.name


def test_keys_and_trail_belong_to_admins_of_all_satellites(service, world, guarded):
    with service.client(service.key("admin", satellites=[world.satellite])) as bound:
        for operation in guarded:
            if operation.scopes == ("admin",):
                answer = bound.request(operation.method, world.url(operation), **world.request(operation))
                assert (answer.status_code, answer.json()["code"]) == (403, "scope_required"), operation.name


def test_methods_that_a_path_has_not_are_405_and_name_those_it_has(service, world, operations):
    known: dict[str, set[str]] = {}
    for operation in operations:
        known.setdefault(operation.path, set()).add(operation.method)
    wrong = []
    with service.client() as admin:
        for path, methods in known.items():
            url = f"{service.url}{path.format(**world.ids, figure='raw')}"
            for method in {"PUT", "PATCH", "DELETE", "TRACE", "POST", "GET", "PROPFIND"} - methods:
                answer = admin.request(method, url)
                allowed = {one.strip() for one in answer.headers.get("allow", "").split(",")}
                served = methods | ({"HEAD"} if "GET" in methods else set())
                if answer.status_code != 405 or not served <= allowed or (allowed - served and "{" not in path):
                    wrong.append(f"{method} {path}: {answer.status_code} {allowed}")
    assert wrong == []


@pytest.mark.parametrize(
    "path",
    [
        *("/api", "/api/", "/api/v1", "/api/v1/", "/api/v2/satellites", "/api/v0/satellites", "/v1/satellites"),
        *("/admin", "/debug", "/redoc", "/swagger", "/.env", "/.git/config", "/server-status", "/api/v1/Satellites"),
        *("/static/0/../pages.py", "/static/0/%2e%2e%2fpages.py", "/static-offline-docs/..%2f..%2fcore.py"),
    ],
)
def test_what_is_not_documented_does_not_answer(service, path):
    with service.client() as admin:
        answer = admin.get(f"{service.url}{path}")
    assert answer.status_code in {404, 405}
    assert "Traceback" not in answer.text


def test_every_path_with_a_route_is_documented_or_a_page(service, operations):
    """The pages of the dashboard and the documentation itself are all that stands outside the document."""
    app = service.server.config.app
    pages = {"/", "/login", "/login/state", "/logout", "/compare", "/jobs", "/keys", "/docs", "/docs/oauth2-redirect"}
    pages |= {"/openapi.json", "/satellites/{satellite_id}", "/sessions/{session_id}", "/parameter-sets/{set_id}"}
    pages |= {"/satellites/{satellite_id}/magnetometers", "/reprocessings", "/reprocessings/{job_id}"}
    pages |= {"/satellites/{satellite_id}/magnetometers/{magnetometer_id}"}
    pages |= {
        "/reasons",
        "/assets/plotly-{named_version}.min.js",
        "/static/{named_version}/{name}",
        "/static-offline-docs",
    }
    assert set(_paths(app.routes, "")) - {operation.path for operation in operations} == pages


def _paths(routes, prefix):
    for route in routes:
        inner = getattr(route, "original_router", None)
        if inner is not None:
            yield from _paths(inner.routes, prefix + route.include_context.prefix)
        else:
            yield prefix + route.path
