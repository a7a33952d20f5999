"""The Python client: what `magcal push`, `magcal report` and `magcal demo` speak, and programs may.

`Client` blocks, `app.client.AsyncClient` awaits; both have the same calls. Every call is safe to repeat, so every
call is repeated where the network or the service asks for it.
"""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

import httpx2
from pydantic import JsonValue

from app.client.requests import (
    ENDED,
    LONGEST_POLL_S,
    POLL_S,
    TRIES,
    Call,
    JobFailedError,
    Progress,
    Query,
    Record,
    ServiceAnswerError,
    ServiceUnreachableError,
    apply_call,
    calibration_call,
    creation,
    is_worth_repeating,
    media_type_of,
    orbits_call,
    pause_s,
    pieces,
    progress_of,
    refusal,
    result_path,
    upload_call,
)

__all__ = [
    "Client",
    "JobFailedError",
    "Progress",
    "Record",
    "ServiceAnswerError",
    "ServiceUnreachableError",
    "media_type_of",
]


class Client:
    """A magcal service at ``url``, spoken to with ``key``; each call is tried up to ``tries`` times."""

    def __init__(self, url: str, key: str, *, tries: int = TRIES, timeout_s: float = 60.0) -> None:
        self._tries = tries
        self._http = httpx2.Client(
            base_url=f"{url.rstrip('/')}/api/v1",
            headers={"Authorization": f"Bearer {key}", "Accept": "application/json"},
            timeout=timeout_s,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_about: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    def create_satellite(self, satellite: str, **about: JsonValue) -> None:
        """Register a satellite; one that is there already is left as it is."""
        self._create(creation("/satellites", {"id": satellite, **about}))

    def create_magnetometer(self, satellite: str, magnetometer: str, unit: str, **about: JsonValue) -> None:
        """Register a magnetometer; one that is there already is left as it is."""
        self._create(creation(f"/satellites/{satellite}/magnetometers", {"id": magnetometer, "unit": unit, **about}))

    def send_orbits(self, satellite: str, text: str, media_type: str = "text/plain") -> list[JsonValue]:
        """Return the orbits that a message became."""
        items = self._record(orbits_call(satellite, text, media_type))["items"]
        return items if isinstance(items, list) else []

    def upload(
        self, satellite: str, magnetometer: str, content: bytes, media_type: str, progress: Progress | None = None
    ) -> Record:
        """Return the session that telemetry became; the same bytes are the same session."""
        return self._record(upload_call(satellite, magnetometer, content, media_type), progress)

    def calibrate(self, session_ids: list[str], progress: Progress | None = None, **options: JsonValue) -> Record:
        """Return the parameter set of a calibration, once its job has ended.

        Raises
        ------
        JobFailedError
            The job failed or was cancelled; the message says why.
        """
        job = self._record(calibration_call(session_ids, options))
        poll_s = POLL_S
        while job["state"] not in ENDED:
            if progress is not None:
                progress(progress_of(job))
            time.sleep(poll_s)
            poll_s = min(1.2 * poll_s, LONGEST_POLL_S)
            job = self._record(Call("GET", f"/jobs/{job['id']}"))
        return self._record(Call("GET", result_path(job)))

    def get(self, path: str, **query: Query) -> Record:
        """Return what ``GET /api/v1{path}`` answers, such as ``/parameter-sets`` or ``/overview``."""
        return self._record(Call("GET", path, params=query))

    def download(self, path: str, **query: str) -> bytes:
        """Return the bytes that ``GET /api/v1{path}`` answers: a table, a report, an export."""
        return self._answer(Call("GET", path, params=query, headers={"Accept": "*/*"})).content

    def apply(
        self, parameter_set_id: str, content: bytes, media_type: str, *, form: str = "csv", inverse: bool = False
    ) -> bytes:
        """Return telemetry corrected with a parameter set, nT; with ``inverse`` raw readings from corrected ones."""
        return self._answer(apply_call(parameter_set_id, content, media_type, form, inverse=inverse)).content

    def _create(self, call: Call) -> None:
        try:
            self._answer(call)
        except ServiceAnswerError as error:
            if error.status != 409:
                raise

    def _record(self, call: Call, progress: Progress | None = None) -> Record:
        document: Record = self._answer(call, progress).json()
        return document

    def _answer(self, call: Call, progress: Progress | None = None) -> httpx2.Response:
        """Return the answer to a call, after as many tries as it takes.

        Raises
        ------
        ServiceAnswerError
            The service refused the call.
        ServiceUnreachableError
            There was no answer, or none but "not now".
        """
        for tried in range(1, self._tries + 1):
            content = call.content
            try:
                answer = self._http.request(
                    call.method,
                    call.path,
                    params=dict(call.params),
                    headers=dict(call.headers),
                    json=call.json,
                    content=content if content is None or progress is None else pieces(content, progress),
                )
            except httpx2.TransportError as error:
                if tried == self._tries:
                    raise ServiceUnreachableError(f"{self._http.base_url} does not answer: {error}") from error
                time.sleep(pause_s(tried, None))
                continue
            if answer.is_success:
                return answer
            if not is_worth_repeating(answer) or tried == self._tries:
                raise refusal(answer)
            time.sleep(pause_s(tried, answer))
        raise ServiceUnreachableError("no tries were allowed")
