"""How connectors ask: one host that the settings name, no redirects, no proxies, a bounded answer, 200 or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from magcal_core.errors import MagcalError

if TYPE_CHECKING:
    import httpx2

TIMEOUT_S: Final = 60.0
MOST_BYTES: Final = 64 << 20
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
        import httpx2

        parts = urlsplit(base_url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise SourceContentError("the address of a source must be an http or https URL")
        self._place = (parts.scheme, parts.hostname, parts.port)
        self._http = httpx2.Client(
            headers={"user-agent": AGENT, **(headers or {})},
            timeout=TIMEOUT_S,
            follow_redirects=False,
            trust_env=False,
        )

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    def get(self, url: str, params: Mapping[str, str] | None = None) -> bytes:
        """Return the body of the answer 200 to a GET."""
        return self._answer("GET", url, params=dict(params or {}))

    def post(self, url: str, form: Mapping[str, str]) -> bytes:
        """Return the body of the answer 200 to a POST of a form."""
        return self._answer("POST", url, form=dict(form))

    def _answer(
        self, method: str, url: str, params: dict[str, str] | None = None, form: dict[str, str] | None = None
    ) -> bytes:
        """Return the body of the answer to one request.

        Raises
        ------
        SourceAnswerError, SourceUnreachableError, SourceContentError
            The answer is none, not 200, or too long; or the URL is another host's.
        """
        import httpx2

        parts = urlsplit(url)
        if (parts.scheme, parts.hostname, parts.port) != self._place:
            raise SourceContentError("the source sends us to another host, which the settings do not name")
        try:
            with self._http.stream(method, url, params=params or None, data=form or None) as answer:
                if answer.status_code != 200:
                    raise _refusal(answer)
                return _bounded(answer)
        except httpx2.HTTPError as error:
            raise SourceUnreachableError(f"no answer: {type(error).__name__}") from error


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
