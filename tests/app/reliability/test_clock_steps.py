"""The machine's clock steps while sets come into force, keys and marks are kept: nothing is amiss afterwards.

Leases under such steps are looked at with real processes in `tests/faults/test_clock.py`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from datetime import datetime, timedelta, tzinfo
from itertools import pairwise

import pytest
from sqlalchemy import select

from app.access.caller import SYSTEM
from app.access.key_repository import KeyRepository
from app.jobs.tables import Job
from app.maintenance.audit import audit
from app.outbox.events import EventType
from app.outbox.subscription import Subscriber
from app.outbox.tables import OutboxEntry
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import Activation, ParameterSet
from app.storage import database as storage
from app.storage.database import new_id, utc_now

CSV = {"content-type": "text/csv"}
STEPS = {
    "a moment back, again and again": ["-50ms", "-150ms", "-300ms"],
    "an hour back": ["-1h", "-1h"],
    "a day forward and back": ["+1d", "+0", "+1d", "+0"],
    "to and fro": ["+1h", "-1d", "+1d", "-1h", "+0"],
}
OFFSETS = {
    "+0": timedelta(),
    "-50ms": -timedelta(milliseconds=50),
    "-150ms": -timedelta(milliseconds=150),
    "-300ms": -timedelta(milliseconds=300),
    "-1h": -timedelta(hours=1),
    "+1h": timedelta(hours=1),
    "-1d": -timedelta(days=1),
    "+1d": timedelta(days=1),
}


class Clock:
    """The machine's clock as the service reads it; intervals go on as they do after a real step."""

    def __init__(self) -> None:
        self.offset = timedelta()
        self.monotonic = time.monotonic

    def now(self, zone: tzinfo | None = None) -> datetime:
        return datetime.now(zone) + self.offset

    def time_ns(self) -> int:
        return time.time_ns() + int(self.offset.total_seconds() * 1e9)


@pytest.fixture
def clock(monkeypatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(storage, "datetime", made)
    monkeypatch.setattr(storage, "time", made)
    return made


class Probe:
    """A subscriber that counts how often it was given each entry."""

    def __init__(self, database) -> None:
        self.database, self.seen = database, Counter()
        self.subscriber = Subscriber("probe", lambda _session, entry: self.seen.update([entry.event_id]))

    def look(self) -> None:
        while self.subscriber.take(self.database):
            pass


def content(number: int) -> str:
    rows = (f"2020-01-01T00:00:{s:02d}Z,{20000 + number},{s},2,20000\n" for s in range(20))
    return "time,bx,by,bz,ref_b\n" + "".join(rows)


def send(api, number: int, key: str):
    headers = CSV | {"Idempotency-Key": key}
    return api.post("/satellites/a/sessions?magnetometer=m", content=content(number), headers=headers)


def new_set(service, session_id: str) -> str:
    """Return a parameter set with what an audit looks for."""
    store = service.services.store
    with service.database.write() as session:
        job = Job(
            id=new_id(), kind="calibration", state="succeeded", priority=0, satellite_id="a", magnetometer_id="m",
            request={}, progress=1.0, attempts=1, lost_attempts=0, cancel_requested=False, created_at=utc_now(),
            result={},
        )  # fmt: skip
        session.add(job)
        session.flush()
        row = ParameterSet(
            id=new_id(), satellite_id="a", magnetometer_id="m", job_id=job.id, status="candidate", grade="accept",
            method="scalar", data_from=utc_now(), data_until=utc_now(), record={}, created_at=utc_now(),
        )  # fmt: skip
        ParameterSetRepository(session, SYSTEM).add(row, [session_id], {"residuals": b"r"}, store)
        return row.id


def turn(service, sets: list[str]) -> None:
    """Put sets in force and take them back, at last every one."""
    for what in ("activate 0", "activate 1", "rollback 1", "activate 2", "rollback 2", "rollback 0"):
        name, number = what.split()
        with service.database.write() as session:
            repository, one = ParameterSetRepository(session, SYSTEM), sets[int(number)]
            repository.activate(one, force=False) if name == "activate" else repository.rollback(one)


def history(service) -> Iterator[Activation]:
    with service.database.read() as session:
        yield from session.scalars(select(Activation).order_by(Activation.begun_at))


@pytest.mark.parametrize("steps", STEPS.values(), ids=STEPS)
def test_no_step_of_the_clock_leaves_anything_amiss(new_service, clock, steps):
    service = new_service()
    probe = Probe(service.database)
    probe.look()
    with service.database.write() as session:
        key = KeyRepository(session).create(["read"], expires_at=utc_now() + timedelta(hours=2)).key
    with service.client() as api, service.client(key) as reader:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        first = send(api, 0, "session").raise_for_status().json()
        wanted = {"kind": "monitoring", "session_ids": [first["id"]]}
        job = api.post("/jobs", json=wanted, headers={"Idempotency-Key": "job"}).json()
        sets = [new_set(service, first["id"]) for _ in range(3)]
        turn(service, sets)
        for number, step in enumerate(steps, start=1):
            clock.offset = OFFSETS[step]
            turn(service, sets)
            again = send(api, 0, "session")
            assert (again.status_code, again.json()["id"]) == (200, first["id"])
            same = api.post("/jobs", json=wanted, headers={"Idempotency-Key": "job"})
            assert same.json()["id"] == job["id"]
            assert send(api, number, f"session-{number}").status_code == 201
            time.sleep(0.6)  # a key is asked for anew after half a second
            is_over = OFFSETS[step] > timedelta(hours=2)
            assert reader.get("/satellites").status_code == (401 if is_over else 200), step
            probe.look()
        clock.offset = timedelta()
        time.sleep(0.6)
        assert reader.get("/satellites").status_code == 200
        turn(service, sets)
    assert audit(service.database, service.services.store).findings == ()
    rows = list(history(service))
    assert len(rows) == 5 * (len(steps) + 2)
    assert all(one.begun_at < one.ended_at <= other.begun_at for one, other in pairwise(rows))
    with service.database.read() as session:
        happened = session.scalars(select(OutboxEntry)).all()
    probe.look()  # what needs attention may have been told of meanwhile
    assert {row.event_id for row in happened} <= set(probe.seen)
    assert set(probe.seen.values()) == {1}
    activated = [row for row in happened if row.type == EventType.PARAMETER_SET_ACTIVATED]
    assert len(activated) == 6 * (len(steps) + 2)
