"""How connectors ask: one host that the settings name, no redirects, no proxies, a bounded answer, 200 or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final
from urllib.parse import urlsplit

import httpx2

from magcal_core.errors import MagcalError

TIMEOUT_S: Final = 60.0
MOST_BYTES: Final = 64 << 20
AGENT: Final = "magcal (in-flight magnetometer calibration)"
_OF_THE_WAY: Final = frozenset({"content-encoding", "content-length", "transfer-encoding"})
"""Headers that say how a body was sent, not what it is."""


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


def client_of(base_url: str, headers: Mapping[str, str] | None = None) -> httpx2.Client:
    """Return an HTTP client that asks the one host of ``base_url``, and whose every answer is a 200.

    It raises the errors of this module, SourceContentError also where ``base_url`` is no address of HTTP.
    """
    parts = urlsplit(base_url)
    if parts.scheme not in {"http", "https"} or not parts.hostname:
        raise SourceContentError("the address of a source must be an http or https URL")
    return httpx2.Client(
        headers={"user-agent": AGENT, **(headers or {})},
        timeout=TIMEOUT_S,
        follow_redirects=False,
        trust_env=False,
        transport=_OneHost(httpx2.URL(base_url)),
    )


class _OneHost(httpx2.BaseTransport):
    """The way to one host: requests to another are refused, answers but 200 are errors, bodies are bounded.

    What a library makes of an answer (redirects, retries) can so not reach further than the settings.
    """

    def __init__(self, base: httpx2.URL) -> None:
        self._place = _place_of(base)
        self._way = httpx2.HTTPTransport(trust_env=False)

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        """Return the answer 200 to a request, its body read.

        Raises
        ------
        SourceAnswerError, SourceUnreachableError, SourceContentError
            The answer is none, not 200, or too long; or the URL is another host's.
        """
        if _place_of(request.url) != self._place:
            raise SourceContentError("the source sends us to another host, which the settings do not name")
        try:
            answer = self._way.handle_request(request)
            try:
                if answer.status_code != 200:
                    raise _refusal(answer)
                body = _bounded(answer)
            finally:
                answer.close()
        except httpx2.HTTPError as error:
            raise SourceUnreachableError(f"no answer: {type(error).__name__}") from error
        headers = [(name, value) for name, value in answer.headers.multi_items() if name.lower() not in _OF_THE_WAY]
        return httpx2.Response(200, headers=headers, content=body)

    def close(self) -> None:
        """Give the connections back."""
        self._way.close()


def _place_of(url: httpx2.URL) -> tuple[str, str, int | None]:
    return url.scheme, url.host, url.port


class SourceClient:
    """Asks the one host of ``base_url``; requests to any other are refused."""

    def __init__(self, base_url: str, headers: Mapping[str, str] | None = None) -> None:
        self._http = client_of(base_url, headers)

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    def get(self, url: str, params: Mapping[str, str] | None = None) -> bytes:
        """Return the body of the answer 200 to a GET; raises the errors of this module."""
        return self._http.get(url, params=dict(params) if params else None).content


def _refusal(answer: httpx2.Response) -> SourceAnswerError:
    pause = answer.headers.get("retry-after", "")
    return SourceAnswerError(answer.status_code, answer.reason_phrase, float(pause) if pause.isdigit() else None)


def _bounded(answer: httpx2.Response) -> bytes:
    pieces, size = [], 0
    for piece in answer.iter_bytes():
        size += len(piece)
        if size > MOST_BYTES:
            raise SourceContentError(f"the answer is longer than {MOST_BYTES >> 20} MiB, which is the limit")
        pieces.append(piece)
    return b"".join(pieces)


def require_no_page(body: bytes) -> bytes:
    """Return ``body``; SourceContentError where it is a page for people instead of data."""
    begin = body[:200].lstrip().lower()
    if begin.startswith((b"<!doctype html", b"<html")):
        raise SourceContentError("it answered with an HTML page, not with data")
    return body
