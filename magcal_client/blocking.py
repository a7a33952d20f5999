"""The Python client: what `magcal push`, `magcal report` and `magcal demo` speak, and programs may.

`Client` blocks, `magcal_client.AsyncClient` awaits; both have the same calls. Every call is safe to repeat, so every
call is repeated where the network or the service asks for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Optional

import httpx2

from magcal_client.errors import JobFailedError, ServiceAnswerError, ServiceUnreachableError
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
    media_type_of,
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
    """A magcal service at ``url``, spoken to with ``key``; each call is tried up to ``tries`` times.

    ``wait`` passes the time between two tries; it may end early, where the caller wants to stop. ``database`` is the id
    of the service's database once an upload was answered.
    """

    def __init__(
        self,
        url: str,
        key: str,
        *,
        tries: int = TRIES,
        timeout_s: float = 60.0,
        wait: Callable[[float], object] = time.sleep,
    ) -> None:
        self._tries = tries
        self.database: str | None = None
        self._wait = wait
        self._http = httpx2.Client(
            base_url=f"{url.rstrip('/')}/api/v1",
            headers={"Authorization": f"Bearer {key}", "Accept": "application/json"},
            timeout=timeout_s,
        )

    def __enter__(self) -> Client:
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

    def confirm(self, satellite: str, magnetometer: str, digests: Sequence[str]) -> Record:
        """Return which telemetry the service has, by the SHA-256 of its bytes: ``held``, or ``expired`` by retention.

        ``database`` is the id of the service's database.
        """
        return self._record(confirm_call(satellite, magnetometer, digests))

    def calibrate(self, session_ids: list[str], progress: Progress | None = None, **options: JsonValue) -> Record:
        """Return the parameter set of a calibration, once its job has ended.

        Raises
        ------
        JobFailedError
            The job failed or was cancelled; the message says why.
        """
        job = self._record(calibration_call(session_ids, options))
        return self._record(Call("GET", result_path(self.wait(str(job["id"]), progress))))

    def wait(self, job_id: str, progress: Optional[Progress] = None) -> Record:
        """Return a job once it has ended: it is told, not asked for, and a stream that breaks is begun anew."""
        tried = 0
        while True:
            try:
                for event in self._stream(f"/jobs/{job_id}/events"):
                    tried = 0
                    if progress is not None:
                        progress(progress_of(event.data))
                    if event.data["state"] in ENDED:
                        return event.data
            except (httpx2.RequestError, ServiceAnswerError) as error:
                tried += 1
                raise_unless_passing(error, tried, self._tries, self._http.base_url)
            self._wait(pause_s(max(1, tried), None))

    def follow(self, after: Optional[str] = None, **query: Query) -> Iterator[Event]:
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
                for event in self._stream("/events", {"Last-Event-ID": after} if after else {}, query):
                    tried, after = 0, event.id
                    if event.type:
                        yield event
            except (httpx2.RequestError, ServiceAnswerError) as error:
                tried += 1
                raise_unless_passing(error, tried, self._tries, self._http.base_url)
            self._wait(pause_s(max(1, tried), None))

    def items(self, path: str, **query: Query) -> Iterator[Record]:
        """Yield every item of a list, such as ``/parameter-sets``, part by part."""
        page = self.get(path, **query)
        while True:
            yield from items_of(page)
            if page.get("next") is None:
                return
            page = self.get(path, **{**query, "cursor": str(page["next"])})

    def monitor(self, session_id: str, **query: Query) -> Record:
        """Return how a session stands to the parameter set in force, or to ``parameter_set``."""
        return self.get(f"/sessions/{session_id}/monitoring", **query)

    def activate(self, parameter_set_id: str, *, force: bool = False, reason: Optional[str] = None) -> Record:
        """Return the parameter set, in force from now on; one with the verdict ``refuse`` wants ``force`` and a reason.

        The audit trail keeps the reason.
        """
        return self._record(activation_call(parameter_set_id, force=force, reason=reason))

    def roll_back(self, parameter_set_id: str) -> Record:
        """Return the parameter set, no longer in force: the one before it is."""
        return self._record(Call("POST", f"/parameter-sets/{parameter_set_id}/rollback"))

    def to_dataframe(self, path: str, **query: str) -> "pandas.DataFrame":
        """Return a table of the service, such as ``/sessions/{id}/samples``, as a data frame; it needs pandas."""
        return frame_of(self.download(path, **{**query, "format": "csv"}))

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

    def _stream(
        self, path: str, headers: Optional[Mapping[str, str]] = None, query: Optional[Mapping[str, Query]] = None
    ) -> Iterator[Event]:
        """Yield the events of one stream until it ends."""
        asked = {"Accept": "text/event-stream", **(headers or {})}
        with self._http.stream("GET", path, params=dict(query or {}), headers=asked) as answer:
            if not is_event_stream(answer):
                answer.read()
                raise refusal_of_stream(answer)
            reader = EventReader()
            for line in answer.iter_lines():
                event = reader.take(line)
                if event is not None:
                    yield event

    def _create(self, call: Call) -> None:
        try:
            self._answer(call)
        except ServiceAnswerError as error:
            if error.status != 409:
                raise

    def _record(self, call: Call, progress: Progress | None = None) -> Record:
        return document_of(self._answer(call, progress))

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
            except httpx2.RequestError as error:
                if tried == self._tries:
                    raise ServiceUnreachableError(f"{self._http.base_url} does not answer: {error}") from error
                self._wait(pause_s(tried, None))
                continue
            self.database = answer.headers.get(DATABASE_HEADER, self.database)
            if answer.is_success:
                return answer
            if not is_worth_repeating(answer) or tried == self._tries:
                raise refusal(answer)
            self._wait(pause_s(tried, answer))
        raise ServiceUnreachableError("no tries were allowed")
