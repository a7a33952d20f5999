"""How connectors ask: one host that the settings name, no redirects, no proxies, a bounded answer, 200 or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from magcal_core.errors import MagcalError

AGENT: Final = "magcal (in-flight magnetometer calibration)"


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


class SourceClient:
    """Asks the one host of ``base_url``; requests to any other are refused."""

    def __init__(self, base_url: str, headers: Mapping[str, str] | None = None) -> None:
        from app.connectors.one_host import client_of

        self._http = client_of(base_url, headers)

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    def get(self, url: str, params: Mapping[str, str] | None = None) -> bytes:
        """Return the body of the answer 200 to a GET; raises the errors of this module."""
        return self._http.get(url, params=dict(params) if params else None).content


def require_no_page(body: bytes) -> bytes:
    """Return ``body``; SourceContentError where it is a page for people instead of data."""
    begin = body[:200].lstrip().lower()
    if begin.startswith((b"<!doctype html", b"<html")):
        raise SourceContentError("it answered with an HTML page, not with data")
    return body
