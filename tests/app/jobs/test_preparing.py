"""Kernels that are not compiled: jobs wait for the compiler and lose no attempt, and everybody can see it."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from app.jobs import kernels
from app.jobs.kernels import Kernels

COMPILER = """
import pathlib, sys, time
sys.stderr.write("\\rcompiling kernels: 2 of 7")
sys.stderr.flush()
while not pathlib.Path(sys.argv[1]).exists():
    time.sleep(0.02)
sys.stderr.write("\\rno room left" if sys.argv[2] == "1" else "\\rcompiled the kernels in 3 s")
sys.exit(int(sys.argv[2]))
"""
CSV = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"


def until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30.0
    while not is_so():
        assert time.monotonic() < deadline, "it did not come to this"
        time.sleep(0.02)


@pytest.fixture
def compiler(tmp_path, monkeypatch) -> Callable[[int], Path]:
    """Put another compiler in the place: it is through, with a status, once the file that is returned exists."""

    def put(status: int) -> Path:
        go = tmp_path / "go"
        monkeypatch.setattr(kernels, "compiled_mark", lambda: tmp_path / "no mark")
        monkeypatch.setattr(kernels, "COMMAND", (sys.executable, "-c", COMPILER, str(go), str(status)))
        return go

    return put


@pytest.mark.parametrize("status", [0, 1])
def test_calculations_begin_when_the_compiler_is_through(compiler, status, monkeypatch):
    go, own, stopping = compiler(status), Kernels(), threading.Event()
    warned: list[tuple[str, dict[str, object]]] = []
    told = SimpleNamespace(info=lambda *_: None, warning=lambda event, **more: warned.append((event, more)))
    monkeypatch.setattr(kernels, "log", told)
    own.prepare()
    until(lambda: own.preparing == (2, 7))
    go.touch()
    assert own.wait(stopping)
    assert own.preparing is None
    own.stop()
    assert warned == ([("kernels_not_compiled", {"status": 1, "why": "no room left"})] if status else [])


def test_workers_that_are_to_stop_do_not_wait_for_the_compiler(compiler):
    compiler(0)
    own, stopping = Kernels(), threading.Event()
    own.prepare()
    until(lambda: own.preparing == (2, 7))
    stopping.set()
    assert not own.wait(stopping)
    own.stop()
    assert own._process is not None
    assert own._process.returncode == -15


def test_where_all_is_compiled_nothing_waits():
    own = Kernels()
    own.prepare()
    assert own.preparing is None
    assert own.wait(threading.Event())


@pytest.mark.parametrize("is_postgres", [False, pytest.param(True, marks=pytest.mark.postgres)])
def test_a_job_waits_for_the_compiler_and_loses_no_attempt(compiler, request, new_service, tmp_path, is_postgres):
    go = compiler(0)
    url = request.getfixturevalue("postgres_url") if is_postgres else None
    store = f"file://{tmp_path}/objects" if is_postgres else None
    service = new_service(workers=1, database_url=url, **({} if store is None else {"store_url": store}))
    if is_postgres:  # the server has no workers there: those of `magcal worker`
        from app.jobs.engines.open_engine import open_engine

        held = service.services
        workers = open_engine(held.database, held.store, service.settings, 1).workers
        workers.start()
    else:
        workers = service.services.workers
    with service.client() as api:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        job = api.post("/jobs", json={"kind": "attitude-simulation", "duration_s": 600}).json()
        until(lambda: workers.kernels.preparing == (2, 7))
        if not is_postgres:
            assert api.get(f"{service.url}/readyz").json()["kernels"] == "preparing: 2 of 7"
            assert api.get(f"{service.url}/readyz").status_code == 200
            assert '<progress aria-label="Compiled so far" max="7" value="2">' in api.get(f"{service.url}/jobs").text
        time.sleep(1.0)
        job = api.get(f"/jobs/{job['id']}").json()
        assert (job["state"], job["attempts"]) == ("queued", 0)
        go.touch()
        until(lambda: api.get(f"/jobs/{job['id']}").json()["state"] == "succeeded")
        assert api.get(f"/jobs/{job['id']}").json()["attempts"] == 1
        assert api.get(f"{service.url}/readyz").json()["kernels"] == "ok"
        assert "preparing" not in api.get(f"{service.url}/jobs").text
    if is_postgres:
        workers.stop(5.0)
