"""The metrics of the service as Prometheus reads them."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import REGISTRY, CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from sqlalchemy import func, select

from app.jobs.tables import Job
from app.sessions.tables import TelemetrySession
from app.storage.database import Database, utc_now
from app.storage.database_store import Blob


class ServiceState:
    """The queue and the store as the database has them; a registry asks for it when it is read."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def collect(self) -> Iterator[Metric]:
        """Yield the gauges."""
        with self._database.read() as session:
            counts = session.execute(select(Job.state, func.count()).group_by(Job.state)).all()
            oldest = session.scalar(select(func.min(Job.created_at)).where(Job.state == "queued"))
            sessions = session.scalar(select(func.count()).select_from(TelemetrySession))
            stored = session.execute(select(func.count(), func.coalesce(func.sum(Blob.size_bytes), 0))).one()
        jobs = GaugeMetricFamily("magcal_jobs", "Jobs by state.", labels=["state"])
        for state, count in counts:
            jobs.add_metric([state], count)
        yield jobs
        age = 0.0 if oldest is None else (utc_now() - oldest).total_seconds()
        yield GaugeMetricFamily("magcal_queue_age_seconds", "Age of the oldest job that waits, s.", value=age)
        yield GaugeMetricFamily("magcal_sessions", "Sessions that are kept.", value=sessions or 0)
        yield GaugeMetricFamily("magcal_store_objects", "Objects in the database's store.", value=stored[0])
        yield GaugeMetricFamily("magcal_store_bytes", "Bytes in the database's store.", value=int(stored[1]))


def metrics_text(database: Database) -> bytes:
    """Return this process's counters and the service's state, in Prometheus' text format."""
    own = CollectorRegistry()
    own.register(ServiceState(database))
    return generate_latest(REGISTRY) + generate_latest(own)
