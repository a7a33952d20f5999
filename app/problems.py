"""An error as a problem: its body, and the HTTP status of each class of error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Final, NotRequired

from typing_extensions import TypedDict

from app.errors import (
    BusyError,
    ConflictError,
    DigestMismatchError,
    ExpiredError,
    IdempotencyMismatchError,
    InProgressError,
    NotAcceptableError,
    NotFoundError,
    QuotaError,
    ReasonRequiredError,
    RefusedVerdictError,
    ScopeRequiredError,
    StorageFullError,
    StoredObjectCorruptError,
    TooManyFailuresError,
    UnauthorizedError,
    UnavailableError,
    UnsupportedMediaError,
    UploadStalledError,
    UploadTooLargeError,
    UploadTruncatedError,
)
from magcal_core.errors import EstimationError, InputError, MagcalError, PropagationError, TooFewSetsError


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


STATUS: Final[Mapping[type[MagcalError], int]] = {
    InputError: 422,
    TooFewSetsError: 409,
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
    ReasonRequiredError: 422,
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
