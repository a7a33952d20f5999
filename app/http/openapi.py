"""The OpenAPI document, completed: which scopes each call needs, and how every error looks."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import JsonValue, TypeAdapter

from app.http.openapi_examples import example_of
from app.problems import Problem

if TYPE_CHECKING:
    from fastapi import FastAPI

SCHEME: Final = "HTTPBearer"
REFERENCE: Final = "#/components/schemas/Problem"
ERRORS: Final[Mapping[str, str]] = {
    "401": "No key, or not a valid one.",
    "403": "The key lacks the scope.",
    "422": "The input is wrong; `errors` says where.",
    "default": "Any other error; `code` tells which.",
}

Document = dict[str, JsonValue]


def complete(app: FastAPI, prefix: str, routers: Sequence[APIRouter]) -> None:
    """Let the OpenAPI document of ``app`` tell of the scopes and errors of every call of ``routers`` under ``prefix``.

    The document is made when it is first asked for.
    """
    plain = app.openapi

    def document() -> Document:
        if app.openapi_schema is None:
            _describe(plain(), prefix, routers)
        return app.openapi_schema or {}

    app.openapi = document  # type: ignore[method-assign]


def _describe(made: Document, prefix: str, routers: Sequence[APIRouter]) -> None:
    schemas = _child(_child(made, "components"), "schemas")
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    problem: Document = TypeAdapter(Problem).json_schema(ref_template="#/components/schemas/{model}")
    schemas |= problem.pop("$defs")  # type: ignore[arg-type]
    schemas["Problem"] = problem
    paths = _child(made, "paths")
    for path, method, route in _calls(prefix, routers):
        operation = _child(_child(paths, path), method)
        scopes = required_scopes(route.dependant)
        if scopes:
            operation["security"] = [{SCHEME: [str(scope)]} for scope in scopes]
        responses = _child(operation, "responses")
        for status, description in ERRORS.items():
            responses[status] = {
                "description": description,
                "content": {"application/problem+json": {"schema": {"$ref": REFERENCE}}},
            }
    for operations in paths.values():
        for one in operations.values() if isinstance(operations, dict) else ():
            _explain_operation(one)
    for name, schema in schemas.items():
        _explain_schema(name, schema)
    for schema in schemas.values():
        _exemplify(schema, schemas)
    for operations in paths.values():
        for one in operations.values() if isinstance(operations, dict) else ():
            _give_examples(one, schemas)


@cache
def words() -> Mapping[str, str]:
    """Return what properties and parameters mean, by name, where their own place does not say it."""
    text = (resources.files("app.http") / "openapi_words.json").read_text(encoding="utf-8")
    found: dict[str, str] = json.loads(text)
    return found


def _explain_operation(operation: JsonValue) -> None:
    """Give an operation its one-line summary, its parameters a meaning, and bodies without a schema one."""
    if not isinstance(operation, dict):
        return
    described = operation.get("description")
    if isinstance(described, str):
        operation["summary"] = described.partition("\n")[0].partition(": ")[0].rstrip(".")
    parameters = operation.get("parameters")
    for one in parameters if isinstance(parameters, list) else []:
        if isinstance(one, dict) and not one.get("description") and str(one["name"]) in words():
            one["description"] = words()[str(one["name"])]
    for part, of_json in (("requestBody", False), ("responses", True)):
        owner = operation.get(part)
        owners = [owner] if part == "requestBody" else list(owner.values()) if isinstance(owner, dict) else []
        for one in owners:
            _give_schemas(one, of_json=of_json)


def _give_examples(operation: JsonValue, schemas: Mapping[str, JsonValue]) -> None:
    """Give each parameter of an operation an example that its schema allows."""
    parameters = operation.get("parameters") if isinstance(operation, dict) else None
    for one in parameters if isinstance(parameters, list) else []:
        if isinstance(one, dict) and "example" not in one and "examples" not in one:
            one["example"] = example_of(one["schema"], schemas, str(one["name"]))


def _give_schemas(owner: JsonValue, *, of_json: bool) -> None:
    """Say of content without a schema that it is bytes, text, or with ``of_json`` an object of JSON."""
    content = owner.get("content") if isinstance(owner, dict) else None
    for kind, media in content.items() if isinstance(content, dict) else ():
        if not isinstance(media, dict) or media.get("schema"):
            continue
        media.pop("itemSchema", None)  # a word of OpenAPI 3.2, which a document of 3.1 may not have
        is_json = kind == "application/json" and of_json
        is_text = kind.startswith("text/") or kind == "application/yaml"
        bytes_or_text: Document = {"type": "string"} if is_text else {"type": "string", "format": "binary"}
        media["schema"] = {"type": "object"} if is_json else bytes_or_text


def _explain_schema(name: str, schema: JsonValue) -> None:
    """Give a schema, and each of its properties, a description where it has none."""
    if not isinstance(schema, dict):
        return
    if "description" not in schema:
        schema["description"] = "Any value of JSON." if name == "JsonValue" else "A part of a list, with its cursor."
    properties = schema.get("properties")
    for own, one in properties.items() if isinstance(properties, dict) else ():
        if isinstance(one, dict) and "description" not in one and own in words():
            one["description"] = words()[own]


def _exemplify(schema: JsonValue, schemas: Mapping[str, JsonValue]) -> None:
    """Give a schema and each of its properties an example that it allows; a schema that is referred to has its own."""
    if not isinstance(schema, dict):
        return
    properties = schema.get("properties")
    for name, one in properties.items() if isinstance(properties, dict) else ():
        if isinstance(one, dict) and not {"examples", "example", "$ref"} & one.keys():
            one["examples"] = [example_of(one, schemas, name)]
    schema["examples"] = [example_of(schema, schemas)]


def _calls(prefix: str, routers: Sequence[APIRouter]) -> Iterator[tuple[str, str, APIRoute]]:
    for router in routers:
        for route in router.routes:
            if isinstance(route, APIRoute) and route.include_in_schema:
                yield from ((prefix + route.path, method.lower(), route) for method in route.methods or ())


def required_scopes(dependant: Dependant) -> tuple[str, ...]:
    """Return the scopes of which a call's key needs one; none where the call is open."""
    own: tuple[str, ...] = getattr(dependant.call, "scopes", ())
    for inner in dependant.dependencies:
        own = own or required_scopes(inner)
    return own


def _child(document: Document, name: str) -> Document:
    child = document[name]
    if not isinstance(child, dict):
        raise TypeError(f"{name} is not an object")
    return child
