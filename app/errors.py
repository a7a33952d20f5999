"""Errors of the service and how every error becomes ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Final, NotRequired

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from typing_extensions import TypedDict

from app.retry import AWAY, is_contention
from magcal_core.errors import EstimationError, InputError, MagcalError, PropagationError

log = structlog.get_logger()

MOST_OF_A_NAME: Final = 100
MOST_OF_A_PLACE: Final = 400
"""Characters of a member's name, and of the way to it, that an answer repeats."""
QUOTED: Final = re.compile(r"""(?<!did you mean )(?<!mapped to )(?:'(?:[^'\\]|\\.){3,}'|"(?:[^"\\]|\\.){3,}")""")
"""A value as the core's messages quote it; names of columns that it proposes stay."""


class FaultBody(TypedDict):
    """One fault of an input, without its value."""

    where: str
    why: str


class Problem(TypedDict):
    """A problem of RFC 9457 with magcal's ``code`` and, for bad input, its faults."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    errors: NotRequired[list[FaultBody]]
    diagnosis: NotRequired[dict[str, object]]
    data_quality: NotRequired[dict[str, object]]


class ServiceError(MagcalError):
    """Base of what only the service can find wrong."""

    headers: Mapping[str, str] = {}


class NotFoundError(ServiceError):
    """There is no such thing, or it belongs to a satellite that the key does not reach."""

    code = "not_found"


class NoMomentsError(NotFoundError):
    """The parameter set has no moments from which its fit could be made again."""

    code = "no_moments"


class ConflictError(ServiceError):
    """The request does not fit the present state."""

    code = "conflict"


class InProgressError(ServiceError):
    """The first request with this Idempotency-Key has not ended yet."""

    code = "in_progress"
    headers = {"Retry-After": "1"}  # noqa: RUF012


class UnauthorizedError(ServiceError):
    """No key, or not a valid one; the same body for every reason."""

    code = "unauthorized"
    headers = {"WWW-Authenticate": 'Bearer realm="magcal"'}  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__("a valid key is needed: Authorization: Bearer KEY")


class ScopeRequiredError(ServiceError):
    """The key lacks a scope."""

    code = "scope_required"


class IdempotencyMismatchError(ServiceError):
    """The Idempotency-Key was used with another request."""

    code = "idempotency_mismatch"


class DigestMismatchError(ServiceError):
    """The body is not what its Content-Digest says."""

    code = "digest_mismatch"


class UploadTruncatedError(ServiceError):
    """The body ended early."""

    code = "upload_truncated"


class UploadTooLargeError(ServiceError):
    """The body is larger than this service takes."""

    code = "upload_too_large"


class UploadStalledError(ServiceError):
    """The body made no progress."""

    code = "upload_stalled"


class UnsupportedMediaError(ServiceError):
    """The body's media type or content coding is not one that this call reads."""

    code = "unsupported_media_type"


class NotAcceptableError(ServiceError):
    """None of the media types in ``Accept`` can be written."""

    code = "not_acceptable"


class QuotaError(ServiceError):
    """More than a key may ask for: of what, how much it may, how much it uses, and when to ask again."""

    code = "quota"

    def __init__(self, what: str, limit: int, used: int, *, reset_s: int) -> None:
        super().__init__(f"{what}: {used}, and the limit is {limit}")
        self.headers = {
            "Retry-After": str(reset_s),
            "RateLimit-Limit": str(limit),
            "RateLimit-Remaining": str(max(0, limit - used)),
            "RateLimit-Reset": str(reset_s),
        }


class TooManyFailuresError(ServiceError):
    """Too many wrong keys."""

    code = "too_many_failures"
    headers = {"Retry-After": "60"}  # noqa: RUF012


class BusyError(ServiceError):
    """The service has as much in hand as it takes; try again."""

    code = "busy"
    headers = {"Retry-After": "1"}  # noqa: RUF012


class UnavailableError(ServiceError):
    """Something that the service needs does not answer; try again."""

    code = "unavailable"
    headers = {"Retry-After": "2"}  # noqa: RUF012


class StorageFullError(ServiceError):
    """There is no room for the upload."""

    code = "storage_full"


class StoredObjectCorruptError(ServiceError):
    """Stored bytes do not have the digest that they were stored under."""

    code = "stored_object_corrupt"


class ExpiredError(ServiceError):
    """The bytes are past their retention and have been removed."""

    code = "expired"


class RefusedVerdictError(ServiceError):
    """The parameter set's verdict is ``refuse``."""

    code = "verdict_refuse"


STATUS: Final[Mapping[type[MagcalError], int]] = {
    InputError: 422,
    EstimationError: 422,
    PropagationError: 422,
    NotFoundError: 404,
    ConflictError: 409,
    InProgressError: 409,
    UnauthorizedError: 401,
    ScopeRequiredError: 403,
    IdempotencyMismatchError: 422,
    DigestMismatchError: 400,
    UploadTruncatedError: 400,
    UploadTooLargeError: 413,
    UploadStalledError: 408,
    UnsupportedMediaError: 415,
    NotAcceptableError: 406,
    QuotaError: 429,
    TooManyFailuresError: 429,
    BusyError: 503,
    UnavailableError: 503,
    StorageFullError: 507,
    StoredObjectCorruptError: 500,
    ExpiredError: 410,
    RefusedVerdictError: 409,
    MagcalError: 500,
}
"""Class of an error -> HTTP status; a class that is not named has its nearest base's."""


def status_of(error: MagcalError) -> int:
    """Return the HTTP status of ``error``."""
    return next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)


def problem(status: int, code: str, detail: str, faults: Sequence[FaultBody] = ()) -> Problem:
    """Return the body of one problem."""
    title = HTTPStatus(status).phrase
    body = Problem(type=f"urn:magcal:problem:{code}", title=title, status=status, detail=detail, code=code)
    if faults:
        body["errors"] = list(faults)
    return body


def problem_of(error: MagcalError) -> Problem:
    """Return the problem that tells of ``error``, without the values that were sent."""
    faults = error.faults if isinstance(error, InputError) else ()
    listed = [FaultBody(where=fault.where, why=fault.why) for fault in faults]
    body = problem(status_of(error), error.code, error.message, listed)
    if error.diagnosis is not None:
        body["diagnosis"] = dict(error.diagnosis)
    if error.data_quality is not None:
        body["data_quality"] = dict(error.data_quality)
    return body


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
    bare["detail"] = QUOTED.sub("'...'", body["detail"])
    if "errors" in body:
        bare["errors"] = [{**fault, "why": QUOTED.sub("'...'", fault["why"])} for fault in body["errors"]]
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
    """Return what is wrong, without the value that pydantic repeats where it is to choose between kinds of a body."""
    context = fault.get("ctx")
    if fault["type"] == "union_tag_invalid" and isinstance(context, Mapping):
        return f"{context['discriminator']} is not one of {context['expected_tags']}"
    return str(fault["msg"])


def _where(path: Sequence[str | int]) -> str:
    first, *rest = path
    steps = (f"[{part}]" if isinstance(part, int) else f".{part[:MOST_OF_A_NAME]}" for part in rest)
    return "".join([str(first), *steps])[:MOST_OF_A_PLACE]


def _http_error(request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, HTTPException):
        raise error
    codes = {404: "not_found", 405: "method_not_allowed", 413: "upload_too_large", 400: "bad_request"}
    code: str = getattr(error, "code", codes.get(error.status_code, "http"))
    body = problem(error.status_code, code, str(error.detail))
    headers = dict(error.headers or {})
    allowed = request.app.state.methods.of(request.url.path) if error.status_code == 405 else []
    if allowed:
        headers["Allow"] = ", ".join(allowed)
    return problem_response(body, headers)


def _database_error(request: Request, error: Exception) -> JSONResponse:
    is_cut = isinstance(error, DBAPIError) and error.connection_invalidated
    if not (is_cut or isinstance(error, AWAY) or is_contention(error)):
        return _unexpected_error(request, error)
    text = str(getattr(error, "orig", error))
    log.warning("database_unavailable", error=text)
    if "disk is full" in text or "No space left" in text:
        return problem_response(problem_of(StorageFullError("there is no room on the disk of the database")))
    unavailable = UnavailableError("the database does not answer in time; try again")
    return problem_response(problem_of(unavailable), unavailable.headers)


def _unexpected_error(request: Request, error: Exception) -> JSONResponse:
    log.error("unexpected_error", path=request.url.path, exc_info=error)
    return problem_response(problem(500, "internal", "an unexpected error; the log has it under the request's id"))
