"""The process that calculates: it is given plain data, gives back plain data, and may be killed at any moment."""

from __future__ import annotations

import importlib
import os
import queue
import resource
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Final

from app.jobs.kinds.contract import Outcome, Report
from app.problems import Problem, problem, problem_of
from magcal_core.errors import MagcalError

PROGRESS_EVERY_S: Final = 0.1
_WARM: Final[set[str]] = set()
"""What `warm_up` has called."""


@dataclass(frozen=True, slots=True)
class Task:
    """A calculation: ``module:function`` and what it is called with."""

    function: str
    work: object


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a calculation found nothing; ``trace`` is for the log."""

    problem: Problem
    trace: str | None = None


Message = float | Outcome | Failure


def load_function(path: str) -> Callable[[object, Report], Outcome]:
    """Return the function at ``module:function``."""
    module, _, name = path.partition(":")
    function: Callable[[object, Report], Outcome] = getattr(importlib.import_module(module), name)
    return function


def calculate(task: Task, report: Report, memory_mb: int) -> Outcome | Failure:
    """Return what ``task`` finds, or why it finds nothing."""
    try:
        return load_function(task.function)(task.work, report)
    except MagcalError as error:
        return Failure(problem_of(error))
    except MemoryError:
        return Failure(problem(500, "job_memory", f"the calculation needs more than {memory_mb} MiB of memory"))
    except Exception:  # noqa: BLE001  the worker's loop: an unforeseen error ends the job, not the worker
        return Failure(problem(500, "internal", "the calculation failed unexpectedly"), traceback.format_exc())


def warm_up(functions: tuple[str, ...]) -> None:
    """Call each of ``functions`` that this process, or the one that it was forked from, has not called yet."""
    for function in functions:
        if function not in _WARM:
            calculate(Task(function, None), lambda _progress: None, 0)
            _WARM.add(function)


def run(connection: Connection, memory_mb: int, warm: tuple[str, ...]) -> None:
    """Serve tasks from ``connection`` until its other end is closed, which also ends a running calculation."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_AS, (memory_mb << 20, memory_mb << 20))
    tasks: queue.SimpleQueue[Task] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(connection, tasks), daemon=True).start()
    warm_up(warm)
    connection.send(0.0)
    while True:
        task = tasks.get()
        connection.send(calculate(task, _Throttle(connection), memory_mb))


def _listen(connection: Connection, tasks: queue.SimpleQueue[Task]) -> None:
    while True:
        try:
            tasks.put(connection.recv())
        except (EOFError, OSError):
            os._exit(0)


class _Throttle:
    """Sends progress to the supervisor, but not more often than it is worth."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sent_at = 0.0

    def __call__(self, progress: float) -> None:
        now = time.monotonic()
        if now - self._sent_at >= PROGRESS_EVERY_S:
            self._sent_at = now
            self._connection.send(float(progress))
