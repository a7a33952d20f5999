"""The client for programs that await: the calls of `magcal_client.Client`, as coroutines."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Optional

import httpx2

from magcal_client.errors import ServiceAnswerError, ServiceUnreachableError
from magcal_client.events import Event, EventReader
from magcal_client.requests import (
    DATABASE_HEADER,
    ENDED,
    TRIES,
    Call,
    JsonValue,
    Progress,
    Query,
    Record,
    activation_call,
    apply_call,
    calibration_call,
    confirm_call,
    creation,
    document_of,
    is_event_stream,
    is_worth_repeating,
    items_of,
    orbits_call,
    pause_s,
    pieces,
    progress_of,
    raise_unless_passing,
    refusal,
    refusal_of_stream,
    result_path,
    upload_call,
)
from magcal_client.tables import frame_of

if TYPE_CHECKING:
    import pandas


class AsyncClient:
    """A magcal service at ``url``, spoken to with ``key``; each call is tried up to ``tries`` times."""

    def __init__(self, url: str, key: str, *, tries: int = TRIES, timeout_s: float = 60.0) -> None:
        self._tries = tries
        self.database: str | None = None
        self._http = httpx2.AsyncClient(
            base_url=f"{url.rstrip('/')}/api/v1",
            headers={"Authorization": f"Bearer {key}", "Accept": "application/json"},
            timeout=timeout_s,
        )

    async def __aenter__(self) -> AsyncClient:
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

    async def confirm(self, satellite: str, magnetometer: str, digests: Sequence[str]) -> Record:
        """Return which telemetry the service has, by the SHA-256 of its bytes: ``held``, or ``expired`` by retention.

        ``database`` is the id of the service's database.
        """
        return await self._record(confirm_call(satellite, magnetometer, digests))

    async def calibrate(self, session_ids: list[str], progress: Progress | None = None, **options: JsonValue) -> Record:
        """Return the parameter set of a calibration, once its job has ended.

        Raises
        ------
        JobFailedError
            The job failed or was cancelled; the message says why.
        """
        job = await self._record(calibration_call(session_ids, options))
        return await self._record(Call("GET", result_path(await self.wait(str(job["id"]), progress))))

    async def wait(self, job_id: str, progress: Optional[Progress] = None) -> Record:
        """Return a job once it has ended: it is told, not asked for, and a stream that breaks is begun anew."""
        tried = 0
        while True:
            try:
                async for event in self._stream(f"/jobs/{job_id}/events"):
                    tried = 0
                    if progress is not None:
                        progress(progress_of(event.data))
                    if event.data["state"] in ENDED:
                        return event.data
            except (httpx2.RequestError, ServiceAnswerError) as error:
                tried += 1
                raise_unless_passing(error, tried, self._tries, self._http.base_url)
            await asyncio.sleep(pause_s(max(1, tried), None))

    async def follow(self, after: Optional[str] = None, **query: Query) -> AsyncIterator[Event]:
        """Yield what happens, without end: what follows the event ``after``, or what comes from now on.

        A stream that breaks is gone on with where it broke; ``type`` and ``satellite`` narrow it.

        Raises
        ------
        ServiceUnreachableError
            There is no answer, however often it is tried.
        """
        tried = 0
        while True:
            try:
                async for event in self._stream("/events", {"Last-Event-ID": after} if after else {}, query):
                    tried, after = 0, event.id
                    if event.type:
                        yield event
            except (httpx2.RequestError, ServiceAnswerError) as error:
                tried += 1
                raise_unless_passing(error, tried, self._tries, self._http.base_url)
            await asyncio.sleep(pause_s(max(1, tried), None))

    async def items(self, path: str, **query: Query) -> AsyncIterator[Record]:
        """Yield every item of a list, such as ``/parameter-sets``, part by part."""
        page = await self.get(path, **query)
        while True:
            for item in items_of(page):
                yield item
            if page.get("next") is None:
                return
            page = await self.get(path, **{**query, "cursor": str(page["next"])})

    async def monitor(self, session_id: str, **query: Query) -> Record:
        """Return how a session stands to the parameter set in force, or to ``parameter_set``."""
        return await self.get(f"/sessions/{session_id}/monitoring", **query)

    async def activate(self, parameter_set_id: str, *, force: bool = False, reason: Optional[str] = None) -> Record:
        """Return the parameter set, in force from now on; one with the verdict ``refuse`` wants ``force`` and a reason.

        The audit trail keeps the reason.
        """
        return await self._record(activation_call(parameter_set_id, force=force, reason=reason))

    async def roll_back(self, parameter_set_id: str) -> Record:
        """Return the parameter set, no longer in force: the one before it is."""
        return await self._record(Call("POST", f"/parameter-sets/{parameter_set_id}/rollback"))

    async def to_dataframe(self, path: str, **query: str) -> "pandas.DataFrame":
        """Return a table of the service, such as ``/sessions/{id}/samples``, as a data frame; it needs pandas."""
        return frame_of(await self.download(path, **{**query, "format": "csv"}))

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

    async def _stream(
        self, path: str, headers: Optional[Mapping[str, str]] = None, query: Optional[Mapping[str, Query]] = None
    ) -> AsyncIterator[Event]:
        """Yield the events of one stream until it ends."""
        asked = {"Accept": "text/event-stream", **(headers or {})}
        async with self._http.stream("GET", path, params=dict(query or {}), headers=asked) as answer:
            if not is_event_stream(answer):
                await answer.aread()
                raise refusal_of_stream(answer)
            reader = EventReader()
            async for line in answer.aiter_lines():
                event = reader.take(line)
                if event is not None:
                    yield event

    async def _create(self, call: Call) -> None:
        try:
            await self._answer(call)
        except ServiceAnswerError as error:
            if error.status != 409:
                raise

    async def _record(self, call: Call, progress: Progress | None = None) -> Record:
        return document_of(await self._answer(call, progress))

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
            except httpx2.RequestError as error:
                if tried == self._tries:
                    raise ServiceUnreachableError(f"{self._http.base_url} does not answer: {error}") from error
                await asyncio.sleep(pause_s(tried, None))
                continue
            self.database = answer.headers.get(DATABASE_HEADER, self.database)
            if answer.is_success:
                return answer
            if not is_worth_repeating(answer) or tried == self._tries:
                raise refusal(answer)
            await asyncio.sleep(pause_s(tried, answer))
        raise ServiceUnreachableError("no tries were allowed")


async def _pieces(content: bytes, progress: Progress) -> AsyncIterator[bytes]:
    for piece in pieces(content, progress):
        yield piece
