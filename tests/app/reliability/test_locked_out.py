"""What the service writes beside requests waits for another process's transaction on SQLite, however long it is."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

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
"""So long another process writes again and again."""
LONGEST_S = 60.0
OTHER = """
import select, sqlite3, sys
path, how = sys.argv[1:]
connection = sqlite3.connect(path, isolation_level=None, timeout=30.0)
connection.execute("BEGIN IMMEDIATE")
print("held", flush=True)
while not select.select([sys.stdin], [], [], 0.05)[0]:
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
def another_process(folder: Path, how: str, is_enough: Callable[[], bool]) -> Iterator[None]:
    """Let another process write to the database meanwhile, until it is enough."""
    (path,) = folder.glob("*.db")
    command = [sys.executable, "-c", OTHER, str(path), how]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        ending = threading.Thread(target=_end, args=(process.stdin, is_enough))
        ending.start()
        try:
            yield
        finally:
            ending.join()
            assert process.wait(30) == 0


def _end(stdin: IO[str], is_enough: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONGEST_S
    while not is_enough() and time.monotonic() < deadline:
        time.sleep(0.05)
    stdin.close()


@pytest.mark.parametrize("how", ["at a stretch", "again and again"])
def test_what_needs_attention_is_told_although_another_process_writes(database, how):
    opened, settings = database
    Watcher(opened, settings, EmbeddedQueue(), Fleet()).round()  # its mark is there
    watcher = Watcher(opened, settings, EmbeddedQueue(), Fleet())  # need not rest, for it has not looked yet
    with opened.write() as session:
        session.add(Magnetometer(satellite_id="a", id="m", unit="nT", created_at=utc_now()))
        append(session, [Event(EventType.SESSION_RECEIVED, {"session_id": "0" * 32}, "a", "m")])
        newest = newest_position(session)
    begun_s = time.monotonic()

    def is_enough() -> bool:
        """At a stretch, once the connection's own patience is over, however late it began to wait."""
        is_retried = any(one["event"] == "retried" for one in logs)
        return is_retried if how == "at a stretch" else time.monotonic() - begun_s > HOLD_S

    with capture_logs() as logs, another_process(settings.data_dir, how, is_enough):
        watcher.round()
        elapsed_s = time.monotonic() - begun_s
    with opened.read() as session:
        mark = session.get_one(OutboxMark, "attention")
        assert mark.position == newest
        assert session.scalars(select(AttentionRaised)).all(), "the magnetometer has no set, and no data"
    if how == "at a stretch":
        assert elapsed_s > BUSY_S, "the connection's own patience is over by then"
        assert [one["event"] for one in logs if one["event"] == "retried"]
