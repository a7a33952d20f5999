"""Bytes that the store has lost come back when they are sent again; bytes that a session needs are never removed."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import httpx2
import pytest
from sqlalchemy import select, update

from app.maintenance.audit import audit
from app.maintenance.rebuild import rebuild
from app.maintenance.removal import remove_objects
from app.maintenance.retention import remove_expired
from app.sessions.tables import TelemetrySession
from app.storage.database import Database
from app.storage.database_store import BlobPart, ObjectToRemove
from app.storage.store import Store, columns_key, raw_key

CSV = {"content-type": "text/csv"}
PASS = "time,bx,by,bz,ref_b\n" + "".join(f"2026-01-01T00:00:{s:02d}Z,2000{s % 10},1,2,20000\n" for s in range(40))


class World:
    """A satellite with two magnetometers, over each kind of store."""

    def __init__(self, service, satellite: str) -> None:
        self.service = service
        url = service.settings.store_url
        self.folder = None if url is None else Path(url.removeprefix("file://"))
        self.database: Database = service.database
        self.store: Store = service.services.store
        self.satellite = satellite
        self.api: httpx2.Client = service.client()
        self.api.post("/satellites", json={"id": satellite}).raise_for_status()
        for name in ("m", "n"):
            where = f"/satellites/{satellite}/magnetometers"
            self.api.post(where, json={"id": name, "unit": "nT"}).raise_for_status()
        self._known = set(audit(self.database, self.store).findings)

    def send(self, magnetometer: str = "m", text: str = PASS, key: str | None = None, **query: str) -> httpx2.Response:
        where = {"magnetometer": magnetometer, **query}
        headers = CSV | ({"idempotency-key": key} if key else {})
        return self.api.post(f"/satellites/{self.satellite}/sessions", params=where, content=text, headers=headers)

    def raw_of(self, sent: httpx2.Response) -> str:
        return raw_key(self.satellite, sent.json()["sha256"])

    def samples(self, session_id: str) -> httpx2.Response:
        return self.api.get(f"/sessions/{session_id}/samples", params={"format": "csv"})

    def lose(self, key: str) -> None:
        with self.database.write() as session:
            self.store.delete(session, key)

    def spoil(self, key: str) -> None:
        """Flip a bit of an object where it lies."""
        if self.folder is not None:
            content = bytearray((self.folder / key).read_bytes())
            content[len(content) // 2] ^= 1
            (self.folder / key).write_bytes(content)
            return
        with self.database.write() as session:
            part = session.get_one(BlobPart, (key, 0))
            middle = len(part.content) // 2
            part.content = part.content[:middle] + bytes([part.content[middle] ^ 1]) + part.content[middle + 1 :]

    def expire(self, session_id: str) -> None:
        """Remove a session's bytes as retention does."""
        with self.database.write() as session:
            before = session.get_one(TelemetrySession, session_id).created_at - timedelta(days=9000)
            session.execute(update(TelemetrySession).where(TelemetrySession.id == session_id).values(data_until=before))
        self.api.patch(f"/satellites/{self.satellite}", json={"retention_days": 8000}).raise_for_status()
        assert [one.session_id for one in remove_expired(self.database, self.store)] == [session_id]
        self.api.patch(f"/satellites/{self.satellite}", json={"retention_days": None}).raise_for_status()

    def codes(self) -> list[str]:
        """Return the codes of what the audit finds now and did not find before."""
        return [one.code for one in audit(self.database, self.store).findings if one not in self._known]


@pytest.fixture
def world(shared, names: Iterator[str]) -> Iterator[World]:
    made = World(shared, next(names))
    yield made
    made.api.close()


@pytest.mark.parametrize("harm", ["lose", "spoil"])
@pytest.mark.parametrize("kind", ["raw", "columns"])
def test_bytes_that_are_lost_or_spoiled_are_stored_again_and_say_so(world, harm, kind):
    sent = world.send()
    assert sent.status_code == 201
    session_id = sent.json()["id"]
    whole = world.samples(session_id).content
    getattr(world, harm)(world.raw_of(sent) if kind == "raw" else columns_key(session_id, 0))
    assert world.codes() == ["stored_object_corrupt"]
    again = world.send()
    assert (again.status_code, again.json()["id"]) == (201, session_id)
    assert world.codes() == []
    assert world.samples(session_id).content == whole
    assert world.send().status_code == 200


def test_a_key_that_finds_its_session_without_bytes_restores_it(world):
    sent = world.send(key=world.satellite)
    world.lose(world.raw_of(sent))
    again = world.send(key=world.satellite)
    assert (again.status_code, again.json()["id"]) == (201, sent.json()["id"])
    assert world.send(key=world.satellite).status_code == 200
    assert world.codes() == []


def test_a_session_that_was_removed_by_mistake_comes_back(world):
    sent = world.send()
    world.expire(sent.json()["id"])
    assert world.samples(sent.json()["id"]).status_code == 410
    again = world.send()
    assert (again.status_code, again.json()["raw_removed_at"]) == (201, None)
    assert world.samples(sent.json()["id"]).status_code == 200
    assert remove_objects(world.database, world.store) == 0
    assert world.codes() == []


def test_a_chunk_that_is_appended_again_is_restored_and_the_session_with_its_last(world):
    first, second = PASS, PASS.replace("2026-01-01", "2026-01-02")
    session_id = world.send(open="true", text=first).json()["id"]
    world.api.post(f"/sessions/{session_id}/samples", content=second, headers=CSV).raise_for_status()
    world.api.post(f"/sessions/{session_id}/close").raise_for_status()
    whole = world.samples(session_id).content
    world.expire(session_id)
    world.api.post(f"/sessions/{session_id}/samples", content=first, headers=CSV).raise_for_status()
    assert world.samples(session_id).status_code == 410
    world.api.post(f"/sessions/{session_id}/samples", content=second, headers=CSV).raise_for_status()
    assert world.samples(session_id).content == whole
    assert world.codes() == []


def test_a_new_session_of_bytes_that_lie_there_spoiled_is_whole(world):
    """Two magnetometers of one satellite share an object; the second may not be acknowledged over a broken one."""
    sent = world.send("m")
    world.spoil(world.raw_of(sent))
    assert world.send("n").status_code == 201
    assert world.codes() == []


def test_bytes_that_another_session_needs_outlive_retention(world):
    old, new = world.send("m"), world.send("n")
    world.expire(old.json()["id"])
    assert world.samples(new.json()["id"]).status_code == 200
    assert world.codes() == []
    world.lose(world.raw_of(new))  # the audit sees that the one that lives needs them, whichever it visits first
    assert world.codes() == ["stored_object_corrupt"]


def test_a_removal_that_was_cut_off_is_seen_and_ended_by_the_next(world):
    """Between the transaction that gives bytes up and their removal: a kill leaves them, and a row that says so."""
    sent = world.send()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("app.maintenance.retention.remove_objects", lambda *_: 0)
        world.expire(sent.json()["id"])
    with world.database.read() as session:
        assert len(session.scalars(select(ObjectToRemove)).all()) == 2
        assert world.store.has(session, [world.raw_of(sent)])
    assert world.codes() == []
    assert remove_objects(world.database, world.store) == 2
    with world.database.read() as session:
        assert not world.store.has(session, [world.raw_of(sent)])
    assert world.codes() == []


def test_rebuild_goes_past_a_bad_object_and_tells_of_it(world):
    sent = [world.send(text=PASS.replace("2026-01-01", f"2026-01-0{day}")) for day in (1, 2, 3)]
    world.lose(world.raw_of(sent[0]))
    for one in sent[1:]:
        world.lose(columns_key(one.json()["id"], 0))
    done = rebuild(world.database, world.store, world.service.settings)
    assert done.changed == 2
    failed = {one.session_id: one.why for one in done.failed}
    assert "stored_object_corrupt" in failed[sent[0].json()["id"]]
    assert not {one.json()["id"] for one in sent[1:]} & set(failed)
    assert world.codes() == ["stored_object_corrupt"]
