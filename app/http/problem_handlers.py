"""What becomes of an error: each one leaves as application/problem+json (RFC 9457)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

import structlog
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException

from app.errors import ServiceError, StorageFullError, UnavailableError, _without_value
from app.http.fault_words import fault_in_words
from app.http.services import HttpServices, services_of
from app.problems import FaultBody, Problem, problem, problem_of
from app.storage.retry import AWAY, DAMAGED, is_contention
from magcal_core.errors import MagcalError

log = structlog.get_logger()


MOST_OF_A_NAME: Final = 100


MOST_OF_A_PLACE: Final = 400
"""Characters of a member's name, and of the way to it, that an answer repeats."""


QUOTED: Final = re.compile(
    r"""(?P<proposed>did\ you\ mean\ '[^']*'|mapped\ to\ '[^']*'|column\ map\ \{[^{}]*\}|--time-format\ "[^"]{1,100}")
    |(?<!\w)'(?:[^'\\]|\\.){3,}'|"(?:[^"\\]|\\.){3,}\"""",
    re.VERBOSE,
)
"""A value as the core's messages quote it; names of columns, and forms of times, that it proposes stay, and so do
apostrophes, which follow a letter."""


def problem_response(body: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return the HTTP answer that carries ``body``."""
    return JSONResponse(body, body["status"], dict(headers or {}), media_type="application/problem+json")


def install_handlers(app: FastAPI) -> None:
    """Let ``app`` answer every error with a problem."""
    app.add_exception_handler(MagcalError, _magcal_error)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, _http_error)
    for kind in (DBAPIError, PoolTimeoutError):
        app.add_exception_handler(kind, _database_error)
    app.add_exception_handler(Exception, _unexpected_error)


def _magcal_error(_request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, MagcalError):
        raise error
    headers = error.headers if isinstance(error, ServiceError) else {}
    return problem_response(_without_values(problem_of(error)), headers)


def _without_values(body: Problem) -> Problem:
    """Return ``body`` with the values that the core quotes left out: an answer does not repeat what was sent."""
    bare = Problem(**body)
    bare["detail"] = QUOTED.sub(_without_value, body["detail"])
    if "errors" in body:
        bare["errors"] = [{**fault, "why": QUOTED.sub(_without_value, fault["why"])} for fault in body["errors"]]
    return bare


def _validation_error(_request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, RequestValidationError):
        raise error
    found = error.errors()
    faults = [FaultBody(where=_where(fault["loc"]), why=_why(fault)) for fault in found[:100]]
    kinds = {str(fault["type"]) for fault in found}
    code = next(iter(kinds)) if len(kinds) == 1 and kinds <= {"extra_forbidden", "time_zone_missing"} else "invalid"
    return problem_response(problem(422, code, "the request is not as the API documentation says", faults))


def _why(fault: Mapping[str, object]) -> str:
    context = fault.get("ctx")
    return fault_in_words(str(fault["type"]), str(fault["msg"]), context if isinstance(context, Mapping) else {})


def _where(path: Sequence[str | int]) -> str:
    first, *rest = path
    steps = (f"[{part}]" if isinstance(part, int) else f".{part[:MOST_OF_A_NAME]}" for part in rest)
    return "".join([str(first), *steps])[:MOST_OF_A_PLACE]


def _is_a_page(request: Request) -> bool:
    """Return whether somebody looks for a page with a browser, not a program for a call of the API."""
    is_asked = request.method in {"GET", "HEAD"} and "text/html" in request.headers.get("accept", "")
    return is_asked and not request.url.path.startswith(("/api/", "/static/", "/assets/"))


def _http_error(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    if error.status_code == 404 and _is_a_page(request):
        return services_of(request.app, HttpServices).unknown_page(request)
    codes = {404: "not_found", 405: "method_not_allowed", 413: "upload_too_large", 400: "bad_request"}
    code: str = getattr(error, "code", codes.get(error.status_code, "http"))
    body = problem(error.status_code, code, str(error.detail))
    headers = dict(error.headers or {})
    allowed = services_of(request.app, HttpServices).methods.of(request.url.path) if error.status_code == 405 else []
    if allowed:
        headers["Allow"] = ", ".join(allowed)
    return problem_response(body, headers)


def _database_error(request: Request, error: Exception) -> JSONResponse:
    is_cut = isinstance(error, DBAPIError) and error.connection_invalidated
    is_damaged = isinstance(error, DBAPIError) and getattr(error.orig, "sqlite_errorname", "").startswith(DAMAGED)
    if not (is_cut or is_damaged or isinstance(error, AWAY) or is_contention(error)):
        return _unexpected_error(request, error)
    text = str(getattr(error, "orig", error))
    log.warning("database_unavailable", error=text)
    if "disk is full" in text or "No space left" in text:
        full = StorageFullError("there is no room on the disk of the database")
        return problem_response(problem_of(full), full.headers)
    unavailable = UnavailableError("the database does not answer in time; try again")
    return problem_response(problem_of(unavailable), unavailable.headers)


def _unexpected_error(request: Request, error: Exception) -> JSONResponse:
    log.error("unexpected_error", path=request.url.path, exc_info=error)
    return problem_response(problem(500, "internal", "an unexpected error; the log has it under the request's id"))
