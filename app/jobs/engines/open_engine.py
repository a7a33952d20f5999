"""Which queue goes with which database, and its life from start to stop."""

from __future__ import annotations

from dataclasses import dataclass

from app.jobs.engines.embedded import EmbeddedQueue, EmbeddedWorkers
from app.jobs.queue import Queue, Workers
from app.settings import Settings
from app.storage.database import Database
from app.storage.store import Store


@dataclass(frozen=True, slots=True)
class Engine:
    """A queue, and the workers of this process if it has any."""

    queue: Queue
    workers: Workers | None


def open_engine(database: Database, store: Store, settings: Settings, workers: int) -> Engine:
    """Return the queue of the settings' database, with ``workers`` workers in this process."""
    if settings.is_postgres:
        from app.jobs.engines.cluster import ClusterQueue, ClusterWorkers

        cluster = ClusterQueue(database)
        return Engine(cluster, ClusterWorkers(database, store, settings, cluster, workers) if workers else None)
    queue = EmbeddedQueue()
    return Engine(queue, EmbeddedWorkers(database, store, settings, queue, workers) if workers else None)
