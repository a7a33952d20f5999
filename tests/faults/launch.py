"""Start `magcal` with faults planted: only the suite starts it like this.

FAULT_CALCULATION: one of `planted`, in place of a calibration. FAULT_POINT: where this process kills itself.
FAULT_WHEN: a file; it kills itself only once this is there. FAULT_PAGES: pages that the SQLite database may grow to,
for a disk that is full. FAULT_GRACE_S: how long a worker that is asked to stop leaves to the job in hand.

With `--stem` it runs nothing itself, but forks a process for each line of its input that asks for one. All that it
forks share one fork server for their calculations.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, event

from app import worker
from app.cli.main import run
from app.jobs.execution import attempt
from app.jobs.execution.child_supervisor import PRELOAD
from app.jobs.kinds.calibration import CalibrationKind
from app.uploads.ingest import Ingest

PRELOADED = ("app.server", "alembic.command", "procrastinate", "psycopg", "pyarrow.pandas_compat")
"""What a server imports by its first upload."""


def die() -> None:
    """Kill this process, now or, where a file is to say so, once that is there."""
    when = os.environ.get("FAULT_WHEN")
    if when is None or Path(when).exists():
        os.kill(os.getpid(), signal.SIGKILL)


def kill_after(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that kills the process when it has done its work."""

    def wrapped(*arguments: Any, **named: Any) -> Any:
        result = method(*arguments, **named)
        die()
        return result

    return wrapped


def note_session(connection: Connection, _cursor: object, statement: str, *_rest: object) -> None:
    if statement.startswith("INSERT INTO session "):
        connection.info["has_session"] = True


def plant() -> None:
    del sys.modules["__main__"].__file__  # else every child runs this file once more
    point = os.environ.get("FAULT_POINT")
    if calculation := os.environ.get("FAULT_CALCULATION"):
        seconds = os.environ.get("PLANTED_S")
        CalibrationKind.function = f"planted:{calculation}" + (f"_{seconds}" if seconds else "")
    if point == "after_commit":
        Ingest.tell = kill_after(Ingest.tell)  # type: ignore[method-assign]
    if point == "before_commit":
        event.listen(Engine, "before_cursor_execute", note_session)
        event.listen(Engine, "commit", lambda connection: die() if connection.info.get("has_session") else None)
    if point == "in_result":
        attempt.finish = kill_after(attempt.finish)
    if grace_s := os.environ.get("FAULT_GRACE_S"):
        worker.STOP_GRACE_S = float(grace_s)  # type: ignore[misc]
    if pages := os.environ.get("FAULT_PAGES"):
        event.listen(
            Engine, "connect", lambda connection, _record: connection.execute(f"PRAGMA max_page_count={int(pages)}")
        )


def fork(command: list[str], environment: dict[str, str], log: str, out: str) -> int:
    """Return the pid of a process forked from this one; in that process, run the command and end."""
    pid = os.fork()
    if pid != 0:
        return pid
    for path, number in ((os.devnull, 0), (out, 1), (log, 2)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
    os.environ.clear()
    os.environ.update(environment)
    forkserver._forkserver.ensure_running = lambda: None  # type: ignore[attr-defined]  # it is the stem's and runs
    plant()
    run(command)
    sys.exit(0)


def stem() -> None:
    """Answer each line that asks for a process with its pid, and each that asks how one has ended with its status."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(list(PRELOAD))
    forkserver.ensure_running()
    for name in PRELOADED:
        importlib.import_module(name)
    for line in sys.stdin:
        asked = json.loads(line)
        if "ended" in asked:
            pid, status = os.waitpid(asked["ended"], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if pid else None
        else:
            answer = fork(**asked)
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    if sys.argv[1:] == ["--stem"]:
        stem()
    else:
        plant()
        run(sys.argv[1:])
