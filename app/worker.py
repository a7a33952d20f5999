"""A worker process: takes jobs until it is asked to stop, then lets those in hand end or hands them back."""

from __future__ import annotations

import signal
import threading
from typing import Final

import structlog

from app.jobs.engines.open_engine import open_engine
from app.logs import configure_logs
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import upgrade
from app.storage.open_store import open_store

STOP_GRACE_S: Final = 20.0
LONGEST_IDLE_S: Final = 30
"""A worker that is paused within a transaction keeps its job's row for so long: another one waits for it."""

log = structlog.get_logger()


def work(settings: Settings, concurrency: int) -> None:
    """Work on jobs until SIGTERM or SIGINT."""
    asked = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: asked.set())
    configure_logs(settings)
    database = Database(settings, longest_idle_s=LONGEST_IDLE_S)
    upgrade(database, settings)
    engine = open_engine(database, open_store(settings), settings, concurrency)
    if engine.workers is not None:
        engine.workers.start()
        log.info("working", concurrency=concurrency)
        asked.wait()
        engine.workers.stop(STOP_GRACE_S)
    database.close()
