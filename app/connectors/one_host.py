"""An HTTP client that reaches one host, whatever a library does with it; loaded where something is asked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final
from urllib.parse import urlsplit

import httpx2

from app.connectors.errors import SourceAnswerError, SourceContentError, SourceUnreachableError

AGENT: Final = "magcal (in-flight magnetometer calibration)"
TIMEOUT_S: Final = 60.0
MOST_BYTES: Final = 64 << 20
_OF_THE_WAY: Final = frozenset({"content-encoding", "content-length", "transfer-encoding"})
"""Headers that say how a body was sent, not what it is."""


def client_of(base_url: str, headers: Mapping[str, str] | None = None) -> httpx2.Client:
    """Return an HTTP client that asks the one host of ``base_url``, and whose every answer is a 200.

    It raises the errors of `app.connectors.errors`, SourceContentError also where ``base_url`` is no address of HTTP.
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
