"""Errors of the service and how every error becomes ``application/problem+json`` (RFC 9457)."""

from __future__ import annotations

from collections.abc import Mapping

from magcal_core.errors import MagcalError


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
