"""The thread that keeps orbits fresh inside a server, where the settings name a source."""

from __future__ import annotations

import threading
from typing import Final

import structlog
from sqlalchemy.exc import SQLAlchemyError

from app.connectors.orbits.watch import OrbitWatch
from app.settings import Settings
from app.storage.database import Database

LOOK_EVERY_S: Final = 60.0

log = structlog.get_logger()


class OrbitWatcher:
    """Looks once a minute for satellites whose turn it is, from start to stop."""

    def __init__(self, database: Database, settings: Settings, source: str) -> None:
        self._stopping = threading.Event()
        self._watch = OrbitWatch(database, settings, source, self._stopping.wait)
        self._thread = threading.Thread(target=self._run, name="orbits")

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Let the request in hand end, and begin none."""
        self._stopping.set()
        self._thread.join()
        self._watch.release()

    def run(self) -> None:
        """Look until `end` is called, in this thread."""
        self._run()
        self._watch.release()

    def end(self) -> None:
        """Ask `run` to return."""
        self._stopping.set()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._watch.round()
            except SQLAlchemyError as error:
                log.warning("orbit_watch_waits", error=str(error))
            self._stopping.wait(LOOK_EVERY_S)
