"""Uploads that share a transaction: durable together, refused each for itself."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy import event, func, select

from app.access.caller import SYSTEM
from app.errors import IdempotencyMismatchError
from app.http.receiving import Upload
from app.jobs.engines.open_engine import open_engine
from app.satellites.repository import SatelliteRepository
from app.satellites.schemas import MagnetometerCreate, SatelliteCreate
from app.sessions.repository import SessionRepository
from app.sessions.schemas import UploadQuery
from app.sessions.tables import Chunk
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import upgrade
from app.storage.open_store import open_store
from app.storage.store import digest, raw_key
from app.uploads.batching import SMALL_BYTES, Keeper
from app.uploads.ingest import Asked, Ingest, Kept
from tests.apart import run_apart


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def settings(request: pytest.FixtureRequest, tmp_path) -> Settings:
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres_url")
    return Settings(data_dir=tmp_path, database_url=url)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    opened = Database(settings)
    upgrade(opened, settings)
    with opened.write() as session:
        satellites = SatelliteRepository(session, SYSTEM)
        satellites.create(SatelliteCreate(id="a"))
        session.flush()
        satellites.add_magnetometer("a", MagnetometerCreate(id="m", unit="nT"))
    yield opened
    opened.close()


@pytest.fixture
def keeper(settings: Settings, database: Database) -> Iterator[Keeper]:
    store = open_store(settings)
    opened = Keeper(Ingest(database, store, open_engine(database, store, settings, 0).queue, settings), database)
    yield opened
    opened.close()


def body(number: int) -> bytes:
    """Return telemetry that is long enough to be read beside the thread that writes."""
    rows = "".join(f"{1_645_310_264 + at},{30_000 + number},{at},7\n" for at in range(6000))
    content = f"time,bx,by,bz\n{rows}".encode()
    assert len(content) > SMALL_BYTES
    return content


def asked(content: bytes, key: str | None = None) -> Asked:
    return Asked(SYSTEM, "a", UploadQuery(magnetometer="m"), Upload(content, digest(content), "text/csv"), key)


@contextmanager
def held(keeper: Keeper) -> Iterator[None]:
    """Hold the thread that writes."""
    go_on = threading.Event()
    keeper._writer.submit(go_on.wait)
    try:
        yield
    finally:
        go_on.set()


async def all_are_read(keeper: Keeper, uploads: int) -> None:
    """Wait until so many uploads wait for the thread that writes."""
    async with asyncio.timeout(60.0):
        while len(keeper._waiting) < uploads:
            await asyncio.sleep(0.01)


async def kept_at_once(keeper: Keeper, uploads: list[Asked]) -> list[Kept | BaseException]:
    """Return what became of uploads that all waited for one transaction."""
    with held(keeper):
        waiting = [asyncio.ensure_future(keeper.keep(one)) for one in uploads]
        await all_are_read(keeper, len(uploads))
    return await asyncio.gather(*waiting, return_exceptions=True)


def stored(database: Database, content: bytes) -> bytes:
    with database.read() as session:
        return open_store(Settings()).get(session, raw_key("a", digest(content)), digest(content))


def test_uploads_that_wait_together_share_one_commit_and_all_are_kept(keeper, database):
    commits = []
    event.listen(database.engine, "commit", commits.append)
    bodies = [body(number) for number in range(20)]
    kept = run_apart(kept_at_once(keeper, [asked(content) for content in bodies]))
    assert all(isinstance(one, Kept) and one.is_new for one in kept), kept
    assert len({one.session.id for one in kept}) == len(bodies)
    assert [stored(database, content) for content in bodies] == bodies
    assert len(commits) == 1


def test_equal_bytes_among_them_are_one_session(keeper, database):
    kept = run_apart(kept_at_once(keeper, [asked(body(0))] * 10))
    assert sorted(one.is_new for one in kept) == [False] * 9 + [True]
    assert len({one.session.id for one in kept}) == 1
    with database.read() as session:
        assert session.scalar(select(func.count()).select_from(Chunk)) == 1


def test_one_that_cannot_be_kept_leaves_the_others_theirs(keeper, database):
    """An Idempotency-Key with two bodies: whichever is written second is refused, alone."""
    uploads = [asked(body(number)) for number in range(6)]
    uploads[2:2] = [asked(body(10), "pass"), asked(body(11), "pass")]
    kept = run_apart(kept_at_once(keeper, uploads))
    assert sorted(isinstance(one, IdempotencyMismatchError) for one in kept[2:4]) == [False, True]
    others = [*kept[:2], *kept[4:]]
    assert all(isinstance(one, Kept) and one.is_new for one in others), others
    with database.read() as session:
        assert SessionRepository(session, SYSTEM).count() == len(uploads) - 1


def test_what_its_client_has_left_before_its_turn_is_not_kept(keeper, database):
    async def leave() -> None:
        with held(keeper):
            first, left = (asyncio.ensure_future(keeper.keep(asked(body(number)))) for number in range(2))
            await all_are_read(keeper, 2)
            left.cancel()
            await asyncio.gather(left, return_exceptions=True)
        await first
        await keeper.keep(asked(body(2)))

    run_apart(leave())
    with database.read() as session:
        found = session.scalars(select(Chunk.sha256)).all()
    assert set(found) == {digest(body(0)), digest(body(2))}
