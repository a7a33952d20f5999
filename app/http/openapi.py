"""The OpenAPI document, completed: which scopes each call needs, and how every error looks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import JsonValue, TypeAdapter

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
