"""What was acknowledged can be audited, made again, and moved to the other database with nothing lost."""

import time
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest
from sqlalchemy import delete, func, select, update

from app.access.key_tables import ApiKey
from app.errors import ConflictError
from app.maintenance.audit import audit
from app.maintenance.copy_database import copy
from app.maintenance.rebuild import rebuild
from app.sessions.tables import Chunk
from app.settings import Settings
from app.storage.database import Base, Database
from app.storage.database_store import Blob, BlobPart, DatabaseStore
from app.storage.migration import upgrade
from app.storage.store import columns_key

STORE = DatabaseStore()


@pytest.fixture
def kept(new_service, data_dir: Path) -> Iterator[tuple[httpx2.Client, Database, str, Settings]]:
    """A service with a session, its parameter set, and an open session of one chunk."""
    service = new_service(workers=1)
    content = (data_dir / "calibration" / "nominal.csv").read_bytes()
    with service.client() as api:
        api.post("/satellites", json={"id": "dekart"}).raise_for_status()
        api.post("/satellites/dekart/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        headers = {"content-type": "text/csv"}
        where = "/satellites/dekart/sessions?magnetometer=mgm"
        session_id = api.post(where, content=content, headers=headers).raise_for_status().json()["id"]
        part = b"".join(content.splitlines(keepends=True)[:50])
        api.post(f"{where}&open=true", content=part, headers=headers).raise_for_status()
        job = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id]}).raise_for_status().json()
        deadline = time.monotonic() + 60
        while api.get(f"/jobs/{job['id']}").json()["state"] != "succeeded":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        service.services.attention_watcher.stop()  # else it writes on while a test compares
        yield api, service.database, session_id, service.settings


def codes(database: Database) -> list[str]:
    return sorted(one.code for one in audit(database, STORE).findings)


def test_an_untouched_store_is_found_whole(kept):
    found = audit(kept[1], STORE)
    assert found.findings == ()
    assert (found.sessions, found.parameter_sets, found.jobs) == (2, 1, 1)
    assert found.objects == 2 * 2 + 2  # raw bytes and columns of two chunks, a residual table and moments


@pytest.mark.parametrize("kind", ["raw", "columns", "residuals", "moments"])
def test_a_flipped_byte_is_found(kept, kind):
    with kept[1].write() as session:
        part = session.scalars(select(BlobPart).where(BlobPart.key.startswith(f"{kind}/"))).first()
        middle = len(part.content) // 2
        part.content = part.content[:middle] + bytes([part.content[middle] ^ 1]) + part.content[middle + 1 :]
    assert codes(kept[1]) == ["stored_object_corrupt"]


def test_rows_without_objects_and_objects_without_rows_are_found(kept):
    with kept[1].write() as session:
        residuals = session.scalars(select(Blob.key).where(Blob.key.startswith("residuals/"))).one()
        STORE.delete(session, residuals)
        STORE.put(session, "raw/dekart/nobody", b"nobody's")
    assert codes(kept[1]) == ["stored_object_corrupt", "unnamed_object"]


def test_a_session_that_is_not_its_chunks_is_found(kept):
    with kept[1].write() as session:
        session.execute(update(Chunk).where(Chunk.session_id == kept[2]).values(samples=Chunk.samples + 1))
    assert codes(kept[1]) == ["count"]


def test_columns_are_made_again_from_the_raw_bytes(kept):
    api, database, session_id, settings = kept
    before = api.get(f"/sessions/{session_id}/samples", headers={"accept": "text/csv"}).content
    with database.write() as session:
        session.execute(delete(BlobPart).where(BlobPart.key == columns_key(session_id, 0)))
    assert codes(database) == ["stored_object_corrupt"]
    done = rebuild(database, STORE, settings)
    assert (done.chunks, done.changed, done.without_bytes) == (2, 1, 0)
    assert codes(database) == []
    assert api.get(f"/sessions/{session_id}/samples", headers={"accept": "text/csv"}).content == before
    assert rebuild(database, STORE, settings).changed == 0


@pytest.mark.postgres
def test_everything_moves_to_postgresql_and_back(kept, postgres_url: str, tmp_path: Path):
    """Each table equal, row by row, after the way there and back."""
    source = kept[1]
    there = Settings(data_dir=tmp_path / "there", database_url=postgres_url)
    back = Settings(data_dir=tmp_path / "back")
    for settings, origin in ((there, source), (back, None)):
        target = Database(settings)
        upgrade(target, settings)
        middle = origin or Database(there)
        counts = copy(middle, target).counts
        assert counts["session"] == 2
        assert counts["parameter_set"] == 1
        assert codes(target) == []
        target.close()
    end = Database(back)
    with source.read() as old, end.read() as new:
        for table in Base.metadata.sorted_tables:
            keys = list(table.primary_key.columns)
            assert old.execute(select(table).order_by(*keys)).all() == new.execute(select(table).order_by(*keys)).all()
    end.close()
    middle.close()


def test_a_target_with_rows_is_refused(kept, tmp_path: Path):
    settings = Settings(data_dir=tmp_path / "full")
    target = Database(settings)
    upgrade(target, settings)
    copy(kept[1], target)
    with pytest.raises(ConflictError, match="not empty"):
        copy(kept[1], target)
    with target.read() as session:
        assert session.scalar(select(func.count()).select_from(Chunk)) == 2
    target.close()


@pytest.mark.postgres
@pytest.mark.parametrize("name", ["n" * 300, "a\0b"], ids=["too long", "NUL"])
def test_a_row_that_does_not_fit_is_named_and_the_rest_is_copied_on_request(kept, postgres_url, tmp_path, name):
    """SQLite keeps what PostgreSQL does not: such a row can only have come from elsewhere than the service."""
    api, source, _, _ = kept
    key_id = api.post("/keys", json={"scopes": ["read"]}).raise_for_status().json()["id"]
    with source.write() as session:
        session.execute(update(ApiKey).where(ApiKey.id == key_id).values(name=name))
    settings = Settings(data_dir=tmp_path / "there", database_url=postgres_url)
    target = Database(settings)
    upgrade(target, settings)
    with pytest.raises(ConflictError, match=rf"api_key \(id='{key_id}'\).*--skip"):
        copy(source, target)
    with target.read() as session:
        assert session.scalar(select(func.count()).select_from(Chunk)) == 0
    copied = copy(source, target, may_skip=True)
    assert len(copied.skipped) == 1
    assert copied.skipped[0].startswith(f"api_key (id='{key_id}'): ")
    with source.read() as old, target.read() as new:
        for table in Base.metadata.sorted_tables:
            count = select(func.count()).select_from(table)
            left_out = int(table.name == "api_key")
            assert new.scalar(count) == old.scalar(count) - left_out == copied.counts[table.name], table.name
    assert codes(target) == []
    target.close()
