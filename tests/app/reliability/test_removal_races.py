"""Retention beside an upload of the same bytes, on PostgreSQL: what is acknowledged is never removed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest

from app.access.caller import SYSTEM
from app.http.receiving import Upload
from app.jobs.engines.open_engine import open_engine
from app.maintenance.audit import audit
from app.maintenance.retention import remove_expired
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.schemas import UploadQuery
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.migration import upgrade
from app.storage.open_store import open_store
from app.storage.retry import retried
from app.storage.store import digest
from app.uploads.ingest import Asked, Ingest, Prepared

pytestmark = pytest.mark.postgres
CONTENT = b"time,bx,by,bz,ref_b\n2020-01-01T00:00:00Z,20000,1,2,20000\n2020-01-01T00:00:01Z,20001,1,2,20000\n"


def asked(magnetometer: str, *, is_open: bool = False) -> Asked:
    query = UploadQuery(magnetometer=magnetometer, open=is_open)
    return Asked(SYSTEM, "a", query, Upload(CONTENT, digest(CONTENT), "text/csv"), None)


@pytest.fixture(params=["database", "folder"])
def place(request: pytest.FixtureRequest, tmp_path: Path, postgres_url: str) -> Iterator[tuple[Database, Ingest]]:
    """A database with an old session of ``m`` that retention removes, and the way in."""
    url = None if request.param == "database" else f"file://{tmp_path}/objects"
    settings = Settings(data_dir=tmp_path, database_url=postgres_url, store_url=url, min_free_mb=0)
    database = Database(settings)
    upgrade(database, settings)
    with database.write() as session:
        session.add(Satellite(id="a", retention_days=1, created_at=datetime(2020, 1, 1, tzinfo=UTC)))
        session.flush()
        for name in ("m", "n"):
            session.add(Magnetometer(satellite_id="a", id=name, unit="nT", created_at=utc_now()))
    store = open_store(settings)
    ingest = Ingest(database, store, open_engine(database, store, settings, 0).queue, settings)
    with database.write() as session:
        ingest.write(session, [ingest.prepare(asked("m"))])
    yield database, ingest
    database.close()


def test_an_upload_that_has_begun_keeps_its_bytes(place):
    """The upload finds the bytes there; retention comes before it has committed."""
    database, ingest = place
    prepared = ingest.prepare(asked("n", is_open=True))
    with ThreadPoolExecutor(1) as pool:
        with database.write() as session:
            ingest.write(session, [prepared])
            removing = pool.submit(remove_expired, database, ingest._store)
            threading.Event().wait(0.5)
        assert len(removing.result(30)) == 1
    assert audit(database, ingest._store).findings == ()


def test_an_append_that_has_begun_keeps_its_bytes(place):
    database, ingest = place
    with database.write() as session:
        empty = Asked(SYSTEM, "a", UploadQuery(magnetometer="n", open=True), Upload(b"", digest(b""), "text/csv"), None)
        kept = ingest.write(session, [ingest.prepare(empty)])[0]
    inside, go_on = threading.Event(), threading.Event()
    write_all = ingest._store.put_all

    def slow(session: object, objects: object) -> None:
        write_all(session, objects)
        inside.set()
        go_on.wait(20)

    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(2) as pool:
        patch.setattr(type(ingest._store), "put_all", lambda _self, session, objects: slow(session, objects))
        upload = Upload(CONTENT, digest(CONTENT), "text/csv")
        appending = pool.submit(ingest.append, SYSTEM, kept.session.id, upload)
        assert inside.wait(20)
        removing = pool.submit(remove_expired, database, ingest._store)
        threading.Event().wait(0.5)
        go_on.set()
        appending.result(30)
        assert len(removing.result(30)) == 1
    assert audit(database, ingest._store).findings == ()


def test_uploads_and_removals_in_a_crowd_leave_an_audit_clean(place):
    """Four uploaders of the same bytes and two that remove, for a while: nothing that was acknowledged is lost."""
    database, ingest = place
    until = datetime.now(UTC).timestamp() + 3

    def upload(number: int) -> None:
        while datetime.now(UTC).timestamp() < until:
            prepared = ingest.prepare(asked("mn"[number % 2]))
            if isinstance(prepared, Prepared):
                retried(partial(write, prepared))

    def write(prepared: Prepared) -> None:
        with database.write() as session:
            ingest.write(session, [prepared])

    def remove(_number: int) -> None:
        while datetime.now(UTC).timestamp() < until:
            remove_expired(database, ingest._store)

    with ThreadPoolExecutor(6) as pool:
        work = [pool.submit(upload, i) for i in range(4)] + [pool.submit(remove, i) for i in range(2)]
        for future in work:
            future.result(60)
    assert audit(database, ingest._store).findings == ()
