"""A worker of the cluster ends when it is asked to, also where the queue's library does not end its own loop."""

import asyncio
import threading
from types import SimpleNamespace

import pytest

from app.jobs.engines import cluster
from app.jobs.engines.cluster import ClusterQueue, ClusterWorkers
from app.settings import Settings
from app.storage.database import Database
from app.storage.open_store import open_store


@pytest.mark.parametrize("is_deaf", [True, False])
def test_a_loop_that_does_not_end_does_not_keep_the_process(tmp_path, monkeypatch, is_deaf):
    settings = Settings(data_dir=tmp_path, store_url=f"file://{tmp_path}/objects")
    database = Database(settings)
    over = threading.Event()

    async def run(self: ClusterWorkers) -> None:
        while not (over.is_set() or (self._stopping.is_set() and not is_deaf)):
            await asyncio.sleep(0.01)

    said: list[str] = []
    monkeypatch.setattr(cluster, "log", SimpleNamespace(warning=lambda event, **_: said.append(event)))
    monkeypatch.setattr(cluster, "LOOP_GRACE_S", 0.2)
    monkeypatch.setattr(ClusterWorkers, "_run", run)
    workers = ClusterWorkers(database, open_store(settings), settings, ClusterQueue(database), 0)
    workers.start()
    workers.stop(0.1)
    assert said == (["queue_loop_left"] if is_deaf else [])
    assert workers._thread.is_alive() == is_deaf
    assert workers._thread.daemon, "the interpreter would wait for it"
    over.set()
    workers._thread.join(10)
    database.close()
