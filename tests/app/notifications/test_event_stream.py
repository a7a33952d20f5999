"""`GET /events`: what happens as server-sent events, from where a reader stopped, as far as its key reaches."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import httpx2
import pytest

from app.outbox.events import Event, EventType
from app.outbox.log import append, newest_position


class Reader:
    """Reads a stream in a thread of its own."""

    def __init__(self, client: httpx2.Client, **asked: object) -> None:
        self.events: list[dict] = []
        self.begun = ""
        self.status = 0
        self.is_open = threading.Event()
        self.is_over = threading.Event()
        self._thread = threading.Thread(target=self._read, args=(client, asked), daemon=True)
        self._thread.start()
        assert self.is_open.wait(20.0), "the stream did not begin"

    def _read(self, client: httpx2.Client, asked: dict[str, object]) -> None:
        with suppress(httpx2.TransportError, httpx2.StreamError):  # the test has closed the client
            self._follow(client, asked)
        self.is_over.set()

    def _follow(self, client: httpx2.Client, asked: dict[str, object]) -> None:
        with client.stream("GET", "/events", **asked) as answer:  # type: ignore[arg-type]
            self.status = answer.status_code
            self.is_open.set()
            event: dict = {}
            for line in answer.iter_lines():
                name, _, value = line.partition(": ")
                if name in {"id", "event"}:
                    event[name] = value
                elif name == "data":
                    event["data"] = json.loads(value)
                elif not line:
                    self.begun = self.begun or event.get("id", "")
                    if "data" in event:
                        self.events.append(event)
                    event = {}


OURS = {"type": [EventType.SESSION_RECEIVED, EventType.JOB_ENDED, EventType.PARAMETER_SET_CREATED]}
"""The types of events that these tests make; the service itself tells of what needs attention when it likes."""


@contextmanager
def reading(service, key: str | None = None, params: dict | None = None, **asked: object) -> Iterator[Reader]:
    with service.client(key) as client:
        yield Reader(client, params=OURS | (params or {}), **asked)


def happen(service, kind: EventType, satellite: str | None, number: int, owner: str | None = None) -> None:
    with service.database.write() as session:
        append(session, [Event(kind, {"cause": str(number), "reason": "r"}, satellite, None, owner)])


def position(service) -> int:
    with service.database.read() as session:
        return newest_position(session)


def numbers(reader: Reader) -> list[str]:
    return [one["data"]["data"]["cause"] for one in reader.events]


def test_an_event_has_id_type_and_body_and_a_quiet_stream_begins_at_once(service, satellite, api, until):
    with reading(service, params={"satellite": satellite}) as reader:
        begun = position(service)
        where = {"params": {"magnetometer": "mgm"}, "headers": {"content-type": "text/csv"}}
        content = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"
        sent = api.post(f"/satellites/{satellite}/sessions", content=content, **where).raise_for_status().json()
        until(lambda: reader.events)
    (event,) = reader.events
    assert int(event["id"]) > begun >= int(reader.begun)
    assert event["event"] == event["data"]["type"] == "session.received"
    assert event["data"]["timestamp"].endswith("Z")
    assert event["data"]["data"] == {
        "session_id": sent["id"], "satellite": satellite, "magnetometer": "mgm", "samples": 1,
        "data_from": "2026-01-01T00:00:00.000000Z", "data_until": "2026-01-01T00:00:00.000000Z",
    }  # fmt: skip


def test_a_reader_goes_on_where_it_stopped_and_an_open_session_is_received_when_it_is_closed(
    service, satellite, api, until
):
    start = position(service)
    where = {"params": {"magnetometer": "mgm", "open": "true"}, "headers": {"content-type": "text/csv"}}
    content = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"
    opened = api.post(f"/satellites/{satellite}/sessions", content=content, **where).raise_for_status().json()
    assert position(service) == start
    api.post(f"/sessions/{opened['id']}/close").raise_for_status()
    api.post(f"/sessions/{opened['id']}/close").raise_for_status()
    for number in range(3):
        happen(service, EventType.JOB_ENDED, satellite, number)
    with reading(service, headers={"Last-Event-ID": str(start)}) as reader:
        until(lambda: len(reader.events) == 4)
    assert [one["event"] for one in reader.events] == ["session.received", *["job.ended"] * 3]
    with reading(service, headers={"Last-Event-ID": reader.events[1]["id"]}) as second:
        until(lambda: len(second.events) == 2)
        happen(service, EventType.PARAMETER_SET_CREATED, satellite, 3)
        until(lambda: len(second.events) == 3)
    assert numbers(second) == ["1", "2", "3"]
    with reading(service, params={"after": str(start), "type": "parameter_set.created"}) as third:
        until(lambda: third.events)
    assert numbers(third) == ["3"]


def test_more_than_a_page_comes_whole_and_in_order(service, names, until):
    name, start = next(names), position(service)
    with service.database.write() as session:
        append(session, [Event(EventType.JOB_ENDED, {"cause": str(n)}, name) for n in range(450)])
    with reading(service, headers={"Last-Event-ID": str(start)}) as reader:
        until(lambda: len(reader.events) == 450)
    assert numbers(reader) == [str(n) for n in range(450)]
    places = [int(one["id"]) for one in reader.events]
    assert places == sorted(set(places))


def test_a_key_sees_its_own_satellites_and_no_other(service, names, until):
    mine, other = next(names), next(names)
    key = service.key("read", satellites=[mine])
    with reading(service, key) as reader:
        happen(service, EventType.JOB_ENDED, other, 0)
        happen(service, EventType.JOB_ENDED, None, 1)
        happen(service, EventType.JOB_ENDED, None, 2, owner=key.split("_")[1])
        happen(service, EventType.JOB_ENDED, mine, 3)
        until(lambda: len(reader.events) == 2)
    assert numbers(reader) == ["2", "3"]


def test_a_revoked_key_sees_no_more(service, api, names, until):
    name, key = next(names), service.key("read")
    with reading(service, key) as reader:
        happen(service, EventType.JOB_ENDED, name, 0)
        until(lambda: reader.events)
        api.post(f"/keys/{key.split('_')[1]}/revoke").raise_for_status()
        until(reader.is_over.is_set)
        happen(service, EventType.JOB_ENDED, name, 1)
        time.sleep(0.5)
    assert numbers(reader) == ["0"]


@pytest.mark.parametrize("given", ["x", "-1", "1.5", "99999999999", "9" * 30])
def test_an_id_that_is_none_is_refused(api, given):
    answer = api.get("/events", headers={"Last-Event-ID": given})
    assert (answer.status_code, answer.json()["code"]) == (422, "event_id")


def test_a_reader_that_was_away_too_long_is_told_so(new_service):
    service = new_service()
    for number in range(5):
        happen(service, EventType.JOB_ENDED, None, number)
    from sqlalchemy import delete

    from app.outbox.tables import OutboxEntry

    with service.database.write() as session:
        session.execute(delete(OutboxEntry).where(OutboxEntry.position <= 3))
    with service.client() as api:
        answer = api.get("/events", headers={"Last-Event-ID": "1"})
        assert (answer.status_code, answer.json()["code"]) == (410, "expired")


def test_a_server_stops_at_once_though_somebody_follows(new_service, until):
    service = new_service()
    with reading(service) as reader:
        begun = time.monotonic()
        service.server.should_exit = True
        until(reader.is_over.is_set)
    assert time.monotonic() - begun < 8.0
