"""What the service writes beside requests waits for another process's transaction on SQLite, however long it is."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import select
from structlog.testing import capture_logs

from app.attention.entries import Fleet
from app.attention.tables import AttentionRaised
from app.attention.watcher import Watcher
from app.jobs.engines.embedded import EmbeddedQueue
from app.outbox.events import Event, EventType
from app.outbox.log import append, newest_position
from app.outbox.tables import OutboxMark
from app.satellites.tables import Magnetometer, Satellite
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.migration import upgrade

BUSY_S = 5.0
"""So long a connection waits for the lock by itself."""
HOLD_S = 5.8
OTHER = """
import sqlite3, sys, time
path, how, hold_s = sys.argv[1], sys.argv[2], float(sys.argv[3])
connection = sqlite3.connect(path, isolation_level=None, timeout=30.0)
connection.execute("BEGIN IMMEDIATE")
print("held", flush=True)
until = time.monotonic() + hold_s
while time.monotonic() < until:
    time.sleep(0.05)
    if how == "again and again":
        connection.execute("COMMIT")
        connection.execute("BEGIN IMMEDIATE")
connection.execute("COMMIT")
"""


@pytest.fixture
def database(tmp_path: Path) -> Iterator[tuple[Database, Settings]]:
    settings = Settings(data_dir=tmp_path)
    opened = Database(settings)
    upgrade(opened, settings)
    with opened.write() as session:
        session.add(Satellite(id="a", created_at=utc_now()))
    yield opened, settings
    opened.close()


@contextmanager
def another_process(folder: Path, how: str) -> Iterator[None]:
    """Let another process write to the database meanwhile."""
    (path,) = folder.glob("*.db")
    command = [sys.executable, "-c", OTHER, str(path), how, str(HOLD_S)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        try:
            yield
        finally:
            assert process.wait(30) == 0


@pytest.mark.parametrize("how", ["at a stretch", "again and again"])
def test_what_needs_attention_is_told_although_another_process_writes(database, how):
    opened, settings = database
    watcher = Watcher(opened, settings, EmbeddedQueue(), Fleet())
    watcher.round()  # its mark is there
    with opened.write() as session:
        session.add(Magnetometer(satellite_id="a", id="m", unit="nT", created_at=utc_now()))
        append(session, [Event(EventType.SESSION_RECEIVED, {"session_id": "0" * 32}, "a", "m")])
        newest = newest_position(session)
    begun_s = time.monotonic()
    with capture_logs() as logs, another_process(settings.data_dir, how):
        watcher.round()
        elapsed_s = time.monotonic() - begun_s
    with opened.read() as session:
        mark = session.get_one(OutboxMark, "attention")
        assert mark.position == newest
        assert session.scalars(select(AttentionRaised)).all(), "the magnetometer has no set, and no data"
    if how == "at a stretch":
        assert elapsed_s > BUSY_S, "the connection's own patience is over by then"
        assert [one["event"] for one in logs if one["event"] == "retried"]
