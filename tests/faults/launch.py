"""Start `magcal` with faults planted: only the suite starts it like this.

FAULT_CALCULATION: one of `planted`, in place of a calibration. FAULT_POINT: where this process kills itself.
FAULT_PAGES: pages that the SQLite database may grow to, for a disk that is full.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from sqlalchemy import Engine, event
from sqlalchemy.orm import Session

from app.cli.main import run
from app.jobs import execute
from app.jobs.calibration import CalibrationKind
from app.jobs.kinds import JOB_KINDS
from app.sessions.ingest import Ingest


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def kill_after(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that kills the process when it has done its work."""

    def wrapped(*arguments: Any, **named: Any) -> Any:
        method(*arguments, **named)
        die()

    return wrapped


def plant() -> None:
    for kind in JOB_KINDS.values():
        kind.warm = (
            ""  # a child that is warm at once costs each of a test's many workers seconds, and no fault needs it
        )
    point = os.environ.get("FAULT_POINT")
    if calculation := os.environ.get("FAULT_CALCULATION"):
        CalibrationKind.function = f"planted:{calculation}"
    if point == "after_commit":
        Ingest.keep = kill_after(Ingest.keep)  # type: ignore[method-assign]
    if point == "before_commit":
        event.listen(Session, "before_commit", lambda session: die() if session.new or session.dirty else None)
    if point == "in_result":
        execute.finish = kill_after(execute.finish)
    if pages := os.environ.get("FAULT_PAGES"):
        event.listen(
            Engine, "connect", lambda connection, _record: connection.execute(f"PRAGMA max_page_count={int(pages)}")
        )


if __name__ == "__main__":
    plant()
    run(sys.argv[1:])
