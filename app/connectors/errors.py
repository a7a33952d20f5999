"""What a source may answer with that is no data."""

from __future__ import annotations

from magcal_core.errors import MagcalError
from magcal_core.foreign_files import web_page


class SourceAnswerError(MagcalError):
    """A source answered with another status than 200; ``retry_after_s`` where it says when to come back."""

    code = "source_answer"

    def __init__(self, status: int, what: str, retry_after_s: float | None = None) -> None:
        super().__init__(f"it answered {status}, {what}")
        self.status = status
        self.retry_after_s = retry_after_s


class SourceUnreachableError(MagcalError):
    """A source gave no answer."""

    code = "source_unreachable"


class SourceContentError(MagcalError):
    """A source answered 200 with something that is not what was asked for."""

    code = "source_content"


def require_no_page(body: bytes) -> bytes:
    """Return ``body``; SourceContentError where it is a page for people instead of data."""
    page = web_page(body)
    if page is not None:
        raise SourceContentError(f"it answered with {page}, not with data")
    return body
