"""The audit tells what is amiss and nothing else, also while stations send and retention removes."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
from sqlalchemy import update

from app.access.caller import SYSTEM
from app.access.idempotency import IdempotencyKey
from app.jobs.tables import Job
from app.maintenance.audit import audit
from app.maintenance.retention import remove_expired
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.sessions.tables import TelemetrySession
from app.storage.database import new_id, utc_now
from app.storage.store import residuals_key

CSV = {"content-type": "text/csv"}
AUDITS = 12
"""Of 55 audits beside uploads into a folder, 51 had a false finding before."""


def content(number: int) -> str:
    rows = (f"2020-01-01T00:00:{s:02d}Z,{20000 + number},{s},2,20000\n" for s in range(20))
    return "time,bx,by,bz,ref_b\n" + "".join(rows)


def prepare(api) -> None:
    api.post("/satellites", json={"id": "a"}).raise_for_status()
    api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()


def send(api, number: int) -> dict:
    return api.post("/satellites/a/sessions?magnetometer=m", content=content(number), headers=CSV).json()


@pytest.mark.parametrize("kind", ["folder", pytest.param("postgres", marks=pytest.mark.postgres)])
def test_audits_beside_uploads_and_removals_find_nothing(new_service, request, tmp_path, kind):
    url = request.getfixturevalue("postgres_url") if kind == "postgres" else None
    service = new_service(database_url=url, store_url=f"file://{tmp_path}/objects")
    store, is_over = service.services.store, threading.Event()
    with service.client() as api:
        prepare(api)
        api.patch("/satellites/a", json={"retention_days": 1}).raise_for_status()

    def upload(first: int) -> int:
        number = first
        with service.client() as api:
            while not is_over.is_set():
                assert "id" in send(api, number)
                number += 10
        return number

    def remove() -> int:
        removed = 0
        while not is_over.wait(0.05):
            removed += len(remove_expired(service.database, store))
        return removed

    with ThreadPoolExecutor(4) as pool:
        work = [pool.submit(upload, number) for number in range(2)]
        removing = pool.submit(remove)
        try:
            found = [audit(service.database, store) for _ in range(AUDITS)]
        finally:
            is_over.set()
        assert [one.findings for one in found if one.findings] == []
        assert found[-1].sessions > found[0].sessions
        assert removing.result(60) > 0
        assert all(one.result(60) > 10 for one in work)


@pytest.fixture
def history(new_service):
    """A service with three sets of one magnetometer, the second of them in force in place of the first."""
    service = new_service()
    store = service.services.store
    with service.client() as api:
        prepare(api)
        session_id = send(api, 0)["id"]
    sets = []
    with service.database.write() as session:
        for _ in range(3):
            job = Job(
                id=new_id(), kind="calibration", state="succeeded", priority=0, request={}, progress=1.0, attempts=1,
                lost_attempts=0, cancel_requested=False, created_at=utc_now(), result={},
            )  # fmt: skip
            session.add(job)
            session.flush()
            row = ParameterSet(
                id=new_id(), satellite_id="a", magnetometer_id="m", job_id=job.id, status="candidate", grade="accept",
                method="scalar", data_from=utc_now(), data_until=utc_now(), record={}, created_at=utc_now(),
            )  # fmt: skip
            ParameterSetRepository(session, SYSTEM).add(row, [session_id], {"residuals": b"r"}, store)
            sets.append(row.id)
    for one in sets[:2]:
        with service.database.write() as session:
            ParameterSetRepository(session, SYSTEM).activate(one, force=False)
    return service, store, sets


def codes(service, store) -> list[str]:
    return sorted({one.code for one in audit(service.database, store).findings})


def test_a_sound_history_has_no_finding(history):
    assert codes(*history[:2]) == []


@pytest.mark.parametrize("harm", ["itself", "forgotten", "status", "overlap"])
def test_activations_that_do_not_follow_one_another_are_found(history, harm):
    service, store, sets = history
    with service.database.write() as session:
        now = session.query(Activation).filter(Activation.ended_at.is_(None)).one()
        before = session.query(Activation).filter(Activation.ended_at.is_not(None)).one()
        if harm == "itself":
            now.parameter_set_id = before.parameter_set_id
            session.get_one(ParameterSet, sets[1]).status = "retired"
            session.flush()
            session.get_one(ParameterSet, sets[0]).status = "active"
        elif harm == "forgotten":
            now.previous_id = None
        elif harm == "status":
            session.get_one(ParameterSet, sets[1]).status = "retired"
        else:
            before.ended_at = now.begun_at + timedelta(seconds=1)
    assert codes(service, store) == ["activation"]


def test_a_reprocessing_that_never_ended_and_a_key_that_names_nothing_are_found(history):
    service, store, _ = history
    with service.database.write() as session:
        session.add(
            Job(
                id=new_id(),
                kind="reprocessing",
                state="running",
                priority=0,
                request={},
                progress=0.0,
                attempts=0,
                lost_attempts=0,
                cancel_requested=False,
                created_at=utc_now(),
            )
        )
        session.add(
            IdempotencyKey(owner="k", key="one", fingerprint="0" * 64, resource_id="0" * 32, created_at=utc_now())
        )
    assert codes(service, store) == ["idempotency_key", "unsettled"]


def test_orphans_and_left_overs_are_found(history):
    service, store, sets = history
    with service.database.write() as session:
        store.put(session, "raw/a/nobody", b"nobody's")
        store.delete(session, residuals_key(sets[2]))
        session.execute(update(TelemetrySession).values(raw_removed_at=utc_now()))
    assert codes(service, store) == ["stored_object_corrupt", "unnamed_object", "unremoved_object"]
    with service.database.write() as session:
        session.query(ParameterSetSession).filter(ParameterSetSession.parameter_set_id == sets[2]).delete()
    assert "no_input" in codes(service, store)
