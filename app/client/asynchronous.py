"""The client for programs that await: the calls of `app.client.blocking.Client`, as coroutines."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
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
    Progress,
    Query,
    Record,
    ServiceAnswerError,
    ServiceUnreachableError,
    apply_call,
    calibration_call,
    creation,
    is_worth_repeating,
    orbits_call,
    pause_s,
    pieces,
    progress_of,
    refusal,
    result_path,
    upload_call,
)


class AsyncClient:
    """A magcal service at ``url``, spoken to with ``key``; each call is tried up to ``tries`` times."""

    def __init__(self, url: str, key: str, *, tries: int = TRIES, timeout_s: float = 60.0) -> None:
        self._tries = tries
        self._http = httpx2.AsyncClient(
            base_url=f"{url.rstrip('/')}/api/v1",
            headers={"Authorization": f"Bearer {key}", "Accept": "application/json"},
            timeout=timeout_s,
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_about: type[BaseException] | BaseException | TracebackType | None) -> None:
        await self.close()

    async def close(self) -> None:
        """Give the connections back."""
        await self._http.aclose()

    async def create_satellite(self, satellite: str, **about: JsonValue) -> None:
        """Register a satellite; one that is there already is left as it is."""
        await self._create(creation("/satellites", {"id": satellite, **about}))

    async def create_magnetometer(self, satellite: str, magnetometer: str, unit: str, **about: JsonValue) -> None:
        """Register a magnetometer; one that is there already is left as it is."""
        await self._create(
            creation(f"/satellites/{satellite}/magnetometers", {"id": magnetometer, "unit": unit, **about})
        )

    async def send_orbits(self, satellite: str, text: str, media_type: str = "text/plain") -> list[JsonValue]:
        """Return the orbits that a message became."""
        items = (await self._record(orbits_call(satellite, text, media_type)))["items"]
        return items if isinstance(items, list) else []

    async def upload(
        self, satellite: str, magnetometer: str, content: bytes, media_type: str, progress: Progress | None = None
    ) -> Record:
        """Return the session that telemetry became; the same bytes are the same session."""
        return await self._record(upload_call(satellite, magnetometer, content, media_type), progress)

    async def calibrate(self, session_ids: list[str], progress: Progress | None = None, **options: JsonValue) -> Record:
        """Return the parameter set of a calibration, once its job has ended.

        Raises
        ------
        JobFailedError
            The job failed or was cancelled; the message says why.
        """
        job = await self._record(calibration_call(session_ids, options))
        poll_s = POLL_S
        while job["state"] not in ENDED:
            if progress is not None:
                progress(progress_of(job))
            await asyncio.sleep(poll_s)
            poll_s = min(1.2 * poll_s, LONGEST_POLL_S)
            job = await self._record(Call("GET", f"/jobs/{job['id']}"))
        return await self._record(Call("GET", result_path(job)))

    async def get(self, path: str, **query: Query) -> Record:
        """Return what ``GET /api/v1{path}`` answers, such as ``/parameter-sets`` or ``/overview``."""
        return await self._record(Call("GET", path, params=query))

    async def download(self, path: str, **query: str) -> bytes:
        """Return the bytes that ``GET /api/v1{path}`` answers: a table, a report, an export."""
        return (await self._answer(Call("GET", path, params=query, headers={"Accept": "*/*"}))).content

    async def apply(
        self, parameter_set_id: str, content: bytes, media_type: str, *, form: str = "csv", inverse: bool = False
    ) -> bytes:
        """Return telemetry corrected with a parameter set, nT; with ``inverse`` raw readings from corrected ones."""
        return (await self._answer(apply_call(parameter_set_id, content, media_type, form, inverse=inverse))).content

    async def _create(self, call: Call) -> None:
        try:
            await self._answer(call)
        except ServiceAnswerError as error:
            if error.status != 409:
                raise

    async def _record(self, call: Call, progress: Progress | None = None) -> Record:
        document: Record = (await self._answer(call, progress)).json()
        return document

    async def _answer(self, call: Call, progress: Progress | None = None) -> httpx2.Response:
        """Return the answer to a call, after as many tries as it takes; the errors are those of the other client."""
        for tried in range(1, self._tries + 1):
            content = call.content
            try:
                answer = await self._http.request(
                    call.method,
                    call.path,
                    params=dict(call.params),
                    headers=dict(call.headers),
                    json=call.json,
                    content=content if content is None or progress is None else _pieces(content, progress),
                )
            except httpx2.TransportError as error:
                if tried == self._tries:
                    raise ServiceUnreachableError(f"{self._http.base_url} does not answer: {error}") from error
                await asyncio.sleep(pause_s(tried, None))
                continue
            if answer.is_success:
                return answer
            if not is_worth_repeating(answer) or tried == self._tries:
                raise refusal(answer)
            await asyncio.sleep(pause_s(tried, answer))
        raise ServiceUnreachableError("no tries were allowed")


async def _pieces(content: bytes, progress: Progress) -> AsyncIterator[bytes]:
    for piece in pieces(content, progress):
        yield piece
