"""What a body may set and what an answer may show (A9, A10)."""

from __future__ import annotations

import json
import re

import pytest

from app.http.fault_words import OTHERWISE
from tests.app.access.conftest import build_world

INTERNAL = {
    "id": "0" * 32,
    "status": "active",
    "state": "succeeded",
    "attempt": 7,
    "attempts": 7,
    "created_at": "2020-01-01T00:00:00Z",
    "created_by": "someone",
    "satellite_id": "another",
    "tenant_id": "another",
    "revoked_at": None,
    "secret_sha256": "00",
    "progress": 1.0,
    "result": {"parameter_set_id": "0" * 32},
    "lease_until": "2099-01-01T00:00:00Z",
    "lock": "x",
    "worker": "x",
    "grade": "accept",
    "__proto__": {"admin": True},
    "is_admin": True,
}
"""Members of rows and of other systems; a body that has one in its own schema keeps it."""
OPEN_ANSWERS = {"ParameterSetRead"}
"""Answers that may hold more than their schema: estimators add results of their own to a parameter set."""


def resolved(document: dict, schema: dict) -> dict:
    while "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def body_schema(document: dict, operation) -> dict | None:
    """Return the schema of the JSON object that the call takes, None where it takes telemetry, text or nothing."""
    content = operation.document.get("requestBody", {}).get("content", {})
    if set(content) != {"application/json"}:
        return None
    schema = content["application/json"]["schema"]
    options = schema.get("anyOf") or schema.get("oneOf") or [schema]
    return resolved(document, next(one for one in options if one.get("type") != "null"))


def writable(document, guarded):
    return [(one, schema) for one in guarded if (schema := body_schema(document, one)) is not None]


def test_every_writable_schema_refuses_members_that_it_does_not_name(api, document, guarded, world):
    """One unknown member beside a sound body: 422 `extra_forbidden`, with its place and not its value."""
    wrong, tried = [], 0
    for operation, schema in writable(document, guarded):
        sound = dict(world.request(operation).get("json", {}))
        for name, value in INTERNAL.items():
            if name in schema["properties"]:
                continue
            tried += 1
            answer = api.request(operation.method, world.url(operation), json={**sound, name: value})
            body = answer.json()
            place = [fault["where"] for fault in body.get("errors", [])]
            if (answer.status_code, body["code"]) != (422, "extra_forbidden") or not place[0].endswith(name):
                wrong.append(f"{operation.name}, {name}: {answer.status_code} {body}")
    assert wrong == []
    assert tried > 80


def test_members_inside_members_are_held_to_their_schema_too(api, names):
    name = next(names)
    api.post("/satellites", json={"id": name}).raise_for_status()
    body = {"id": "m", "unit": "nT", "policy": {"calibrate": True, "created_by": "me"}}
    answer = api.post(f"/satellites/{name}/magnetometers", json=body)
    assert (answer.status_code, answer.json()["code"]) == (422, "extra_forbidden")
    assert answer.json()["errors"][0]["where"] == "body.policy.created_by"


def test_every_schema_of_a_body_forbids_what_it_does_not_name(document, guarded):
    """The document says so itself, all the way down."""
    wrong = []

    def check(schema: dict, name: str) -> None:
        schema = resolved(document, schema)
        if schema.get("type") == "object" and schema.get("additionalProperties", True) is True:
            wrong.append(name)
        parts = [*schema.get("anyOf", []), *schema.get("oneOf", []), *schema.get("properties", {}).values()]
        for part in [*parts, *([schema["items"]] if "items" in schema else [])]:
            check(part, f"{name} > {part.get('title', part.get('$ref', ''))}")

    for operation, schema in writable(document, guarded):
        check(schema, operation.name)
    assert wrong == []


def test_every_query_refuses_parameters_that_it_does_not_name(api, guarded, world):
    wrong = []
    for operation in guarded:
        if operation.path.endswith("/events"):
            continue
        request = world.request(operation)
        query = {**request.pop("params", {}), "sort": "id; DROP TABLE job", "unknown": "1"}
        answer = api.request(operation.method, world.url(operation), params=query, **request)
        declares = any(one["in"] == "query" for one in operation.document.get("parameters", []))
        if declares and operation.method == "GET" and answer.status_code != 422:
            wrong.append(f"{operation.name}: {answer.status_code}")
        assert answer.status_code < 500, operation.name
    assert wrong == []


def test_every_answer_has_a_schema_and_holds_to_it(api, document, guarded, world):
    """Each 2xx of every call: JSON answers name a closed model and have no member beyond it."""
    wrong = []
    for operation in guarded:
        for status, response in operation.document["responses"].items():
            schema = response.get("content", {}).get("application/json", {}).get("schema")
            if not status.startswith("2") or schema is None:
                continue
            model = resolved(document, schema)
            is_table = schema == {} or schema.get("additionalProperties", {}).get("type") == "array"
            is_document = operation.path.endswith("/export") or "/figures/" in operation.path
            is_open = model.get("type") == "object" and "properties" not in model
            if is_open and not is_table and not (is_document and model == {"type": "object"}):
                wrong.append(f"{operation.name} {status}: an open object")
        if operation.method == "GET" and not operation.path.endswith("/events"):
            answer = api.get(world.url(operation), params=world.request(operation).get("params"))
            schema = operation.document["responses"]["200"].get("content", {}).get("application/json", {}).get("schema")
            if schema and answer.headers["content-type"].startswith("application/json") and "$ref" in schema:
                wrong += surplus(document, schema, answer.json(), operation.name)
    assert wrong == []


def surplus(document: dict, schema: dict, value: object, where: str) -> list[str]:
    """Return the members of an answer that its schema does not name."""
    name = schema.get("$ref", "").rpartition("/")[2]
    schema = resolved(document, schema)
    found = []
    if isinstance(value, dict) and "properties" in schema:
        extra = set(value) - set(schema["properties"])
        if extra and name not in OPEN_ANSWERS:
            found.append(f"{where}: {sorted(extra)}")
        for key, part in schema["properties"].items():
            if key in value:
                found += surplus(document, part, value[key], f"{where}.{key}")
    elif isinstance(value, list) and "items" in schema:
        for one in value:
            found += surplus(document, schema["items"], one, where)
    return found


def test_no_answer_shows_a_secret_or_its_hash(service, api, guarded, world):
    """Also the list of keys and the trail: the hash of a secret is as little shown as the secret."""
    made = api.post("/keys", json={"scopes": ["read"], "name": "shown once"}).json()
    secret = made["key"].split("_", 2)[2]
    for operation in guarded:
        if operation.method == "GET" and not operation.path.endswith("/events"):
            answer = api.get(world.url(operation), params=world.request(operation).get("params"))
            assert secret not in answer.text
            assert "sha256_" not in answer.text
            assert "secret" not in answer.text, operation.name


ECHO = "Zq7Echo"


def test_no_refusal_repeats_a_value_that_was_sent(api, document, guarded, names):
    """Every text of every body and query replaced by a mark, one at a time: no refusal has the mark.

    In a world of its own: some marks are accepted, and a magnetometer with a mark for a column reads nothing any more.
    """
    world, wrong = build_world(api, next(names)), []
    for operation, schema in writable(document, guarded):
        sound = dict(world.request(operation).get("json", {}))
        for name in schema["properties"]:
            for value in (ECHO, [ECHO], {"x": ECHO}, [{"x": ECHO}]):
                answer = api.request(operation.method, world.url(operation), json={**sound, name: value})
                if answer.status_code >= 400 and ECHO in answer.text:
                    wrong.append(f"{operation.name}, {name}: {answer.text}")
                assert answer.status_code < 500, (operation.name, name)
    for operation in guarded:
        if operation.method != "GET" or operation.path.endswith("/events"):
            continue
        for one in operation.document.get("parameters", []):
            if one["in"] == "query":
                answer = api.get(world.url(operation), params={one["name"]: ECHO})
                if answer.status_code >= 400 and ECHO in answer.text:
                    wrong.append(f"{operation.name}, ?{one['name']}: {answer.text}")
                assert answer.status_code < 500, (operation.name, one["name"])
    assert wrong == []


@pytest.mark.parametrize("headers", [{"accept": ECHO}, {"content-type": ECHO}, {"content-encoding": ECHO}])
def test_no_refusal_repeats_a_header(api, world, headers):
    answer = api.post(
        f"/satellites/{world.satellite}/sessions", params={"magnetometer": "mgm"}, content=b"x", headers=headers
    )
    assert ECHO.lower() not in answer.text.lower()
    assert json.loads(answer.content)["code"]


WRONG_VALUES = [None, True, -1, 1.5, 10**30, "", "a" * 5000, "\u202e", [], [None] * 2000, {}, {"a": {"b": 1}}]
VALIDATORS_OWN = re.compile(r"[Ii]nput|should|permitted|[Vv]alue error|Field required|[Uu]nable to")


def test_what_is_wrong_with_a_value_is_said_in_our_words(api, document, guarded, world):
    """Values of every kind in the place of every member and parameter; no word of the validator, none that fits all."""
    said = {}
    for operation, schema in writable(document, guarded):
        sound = dict(world.request(operation).get("json", {}))
        for name in schema["properties"]:
            for value in WRONG_VALUES:
                answer = api.request(operation.method, world.url(operation), json={**sound, name: value, "zz": 1})
                said |= {fault["why"]: f"{operation.name} {name}" for fault in answer.json().get("errors", [])}
        answer = api.request(operation.method, world.url(operation), json=[])
        said |= {fault["why"]: operation.name for fault in answer.json().get("errors", [])}
    for operation in guarded:
        for one in operation.document.get("parameters", []):
            for value in ("", "x" * 3000, "1.5", "-1", "true") if one["in"] == "query" else ():
                answer = api.request(operation.method, world.url(operation), params={one["name"]: value, "zz": "1"})
                if answer.status_code == 422:
                    said |= {fault["why"]: f"{operation.name} {one['name']}" for fault in answer.json()["errors"]}
    assert len(said) > 40
    assert {text: where for text, where in said.items() if VALIDATORS_OWN.search(text) or text == OTHERWISE} == {}
