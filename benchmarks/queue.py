"""The queue with jobs that hardly calculate: jobs a second from the first claim to the last result, on both databases.

``MAGCAL_BENCH_JOBS`` jobs (default 400; half of them embedded), each a simulation of ten seconds that takes some
milliseconds. Then the time that one claim takes with ten thousand jobs waiting of ten satellites, without a server.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sqlalchemy import func, select

from app.access.caller import SYSTEM
from app.jobs.engines.open_engine import open_engine
from app.jobs.execution.leases import Sightings, claim_next, finish
from app.jobs.fair_order import take_turns
from app.jobs.kinds.attitude_simulation import AttitudeBody
from app.jobs.repository import JobRepository
from app.jobs.tables import Job
from app.satellites.tables import Satellite
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.migration import upgrade
from app.storage.open_store import open_store
from benchmarks.measure import Figure
from benchmarks.service import cpu_s_of, postgres, process, scratch

ROOM: Final = "queue"
JOBS: Final = int(os.environ.get("MAGCAL_BENCH_JOBS", "400"))
WARM_UP: Final = 4
"""Jobs that every worker does before it is timed, so that its child has compiled the simulation."""
WAITING: Final = 10_000
SATELLITES: Final = 10
CLAIMS: Final = 300
CLAIM_AIM_MS: Final = 20.0
PATIENCE_S: Final = 240.0


@dataclass(frozen=True, slots=True)
class Throughput:
    """Jobs a second, and the processor time of one in its worker and below it, ms."""

    rate: float
    worker_ms: float
    child_ms: float


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder:
        settings = Settings(data_dir=folder / "embedded")
        yield _figure("one process on SQLite, 2 job workers", _throughput(settings, folder, JOBS // 2, 1, "2"), 30.0)
    with scratch() as folder, postgres(folder) as url:
        settings = Settings(data_dir=folder / "data", database_url=url)
        for workers, aim in ((1, None), (2, 100.0), (4, None)):
            what = f"{workers} worker process{'es' if workers > 1 else ''} on PostgreSQL"
            yield _figure(what, _throughput(settings, folder, JOBS, workers), aim)
    with scratch() as folder:
        yield from _claims(Settings(data_dir=folder))


def _figure(where: str, found: Throughput, aim: float | None) -> Figure:
    rate = found.rate
    note = (
        f"first claim to last result; each job {found.worker_ms:.1f} ms of its worker's processor "
        f"and {found.child_ms:.1f} ms of its calculation's"
    )
    return Figure(
        ROOM,
        f"small jobs, {where}",
        rate,
        "1/s",
        f">= {aim:g}" if aim else "",
        None if aim is None else rate >= aim,
        note,
    )


def _throughput(settings: Settings, folder: Path, count: int, workers: int, concurrency: str = "1") -> Throughput:
    """Return how ``count`` jobs pass over ``workers`` processes."""
    database = Database(settings)
    upgrade(database, settings)
    environment = {"MAGCAL_DATA_DIR": str(settings.data_dir)}
    if settings.database_url is not None:
        environment["MAGCAL_DATABASE_URL"] = settings.database_url
    with ExitStack() as running:
        command = ("worker", "--concurrency", concurrency)
        pids = [running.enter_context(process(folder, environment, *command)).pid for _ in range(workers)]
        _submit(database, settings, WARM_UP * workers * int(concurrency))
        _wait(database)
        before = cpu_s_of(pids)
        ids = _submit(database, settings, count)
        _wait(database)
        worker_ms, child_ms = (1e3 * (now - then) / count for now, then in zip(cpu_s_of(pids), before, strict=True))
    rate = _rate(database, ids)
    database.close()
    return Throughput(rate, worker_ms, child_ms)


def _submit(database: Database, settings: Settings, count: int) -> list[str]:
    """Return the ids of ``count`` small jobs, queued in one transaction."""
    queue = open_engine(database, open_store(settings), settings, 0).queue
    with database.write() as session:
        jobs = JobRepository(session, SYSTEM)
        return [
            jobs.submit(AttitudeBody(kind="attitude-simulation", duration_s=10.0, seed=i), queue).id
            for i in range(count)
        ]


def _wait(database: Database) -> None:
    deadline = time.monotonic() + PATIENCE_S
    unended = select(func.count()).where(Job.state.in_(("queued", "running")))
    while True:
        with database.read() as session:
            if not session.scalar(unended):
                return
        if time.monotonic() > deadline:
            raise TimeoutError("the jobs did not end in time")
        time.sleep(0.05)


def _rate(database: Database, ids: list[str]) -> float:
    """Return jobs a second between the first claim and the last result of the jobs from the first of ``ids`` on."""
    ours = Job.id.in_(ids)
    with database.read() as session:
        times = select(func.min(Job.started_at), func.max(Job.finished_at), func.count())
        first, last, count = session.execute(times.where(ours, Job.state == "succeeded")).one()
    if count != len(ids) or first is None or last is None:
        raise RuntimeError(f"{len(ids) - count} jobs did not succeed")
    return float(count / (last - first).total_seconds())


def _claims(settings: Settings) -> Iterator[Figure]:
    """Yield the time of a claim and of what is claimed first, with `WAITING` jobs in the queue (L8)."""
    database = Database(settings)
    upgrade(database, settings)
    with database.write() as session:
        names = [f"sat-{number}" for number in range(SATELLITES)]
        session.add_all(Satellite(id=name, created_at=utc_now()) for name in names)
        session.flush()
        owners = [names[0] if number < WAITING // 2 else names[number % SATELLITES] for number in range(WAITING)]
        jobs = [_waiting(name) for name in owners]
        take_turns(session, jobs)
        session.add_all(jobs)
    sightings = Sightings(settings.job_lease_s, settings.job_heartbeat_s)
    durations_ms, satellites = [], []
    for _ in range(CLAIMS):
        begun = time.perf_counter()
        with database.write() as session:
            claim = claim_next(session, "bench", settings.job_lease_s, settings.job_attempts, sightings.lapsed(session))
        durations_ms.append(1e3 * (time.perf_counter() - begun))
        if claim is None:
            raise RuntimeError("nothing to claim")
        with database.write() as session:
            satellites.append(session.get_one(Job, claim.job_id).satellite_id)
            finish(session, claim, "succeeded", result={})
    database.close()
    p99 = statistics.quantiles(durations_ms, n=100)[98]
    what = f"L8 claim with {WAITING} jobs waiting, p99"
    note = f"median {statistics.median(durations_ms):.2f} ms, each with its durable commit"
    yield Figure(ROOM, what, p99, "ms", f"<= {CLAIM_AIM_MS:g}", p99 <= CLAIM_AIM_MS, note)
    shares = sorted(satellites.count(name) / CLAIMS * SATELLITES for name in names)
    what = f"L8 fairness: largest share of {SATELLITES} satellites, one of which queued half of all first"
    yield Figure(ROOM, what, shares[-1], "of its share", "<= 2", shares[-1] <= 2.0, f"smallest {shares[0]:.2f}")


def _waiting(satellite_id: str) -> Job:
    plain = {"progress": 0.0, "attempts": 0, "lost_attempts": 0, "cancel_requested": False, "request": {}}
    return Job(
        id=new_id(),
        kind="attitude-simulation",
        state="queued",
        priority=0,
        satellite_id=satellite_id,
        created_at=utc_now(),
        **plain,
    )
