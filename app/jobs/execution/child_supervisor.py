"""The parent's side of a calculation: starts the child, watches it, and kills it when it must end."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from typing import Final

from app.errors import ServiceError
from app.jobs.execution.child import Failure, Message, Task, run
from app.jobs.kinds.contract import Outcome

TICK_S: Final = 0.1
START_S: Final = 300.0
"""A child that is not warm after so long is given up."""
PRELOAD: Final = ("numpy", "scipy.linalg", "pyarrow", "numba", "app.jobs.execution.warm_start")


Watch = Callable[[float], bool]


class ChildDiedError(ServiceError):
    """The child ended in the middle of its calculation: a crash, or too much memory."""

    code = "child_died"


class TimedOutError(ServiceError):
    """The calculation took longer than it may."""

    code = "timed_out"


class AbandonedError(ServiceError):
    """The supervisor was asked to end the calculation."""

    code = "abandoned"


class Calculator:
    """One child process, started ahead of need and used again as long as it is healthy."""

    def __init__(self, memory_mb: int, warm: tuple[str, ...] = ()) -> None:
        self._memory_mb = memory_mb
        self._warm = warm
        self._child: ForkServerProcess | None = None
        self._connection: Connection | None = None
        self._is_warm = False
        self._starting = threading.Lock()

    def prepare(self) -> None:
        """Have the child started, if there is none, without waiting for it or for what it is forked from."""
        threading.Thread(target=self._start, daemon=True).start()

    def _start(self) -> None:
        with self._starting:
            if self._child is not None and self._child.is_alive():
                return
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(list(PRELOAD))
            ours, theirs = context.Pipe()
            self._child = context.Process(target=run, args=(theirs, self._memory_mb, self._warm), daemon=True)
            self._child.start()
            theirs.close()
            self._connection = ours

    def run(self, task: Task, timeout_s: float, watch: Watch) -> Outcome | Failure:
        """Return what ``task`` finds.

        ``watch`` is called with the progress several times a second; where it returns False, the child is killed.
        The time counts from when the child is warm.

        Raises
        ------
        TimedOutError, AbandonedError, ChildDiedError
            The child was killed for its time, for ``watch``, or died by itself.
        """
        self._start()
        if self._connection is None:
            raise ChildDiedError("the calculation's process could not be started")
        try:
            self._warm_up(self._connection, watch)
            self._connection.send(task)
            return self._listen(self._connection, timeout_s, watch)
        except (EOFError, ConnectionError, BrokenPipeError):
            raise ChildDiedError(f"the calculation's process died, {self._obituary()}") from None
        except BaseException:  # whatever it was, this child must not answer the next task with this one's result
            self.kill()
            raise

    def _warm_up(self, connection: Connection, watch: Watch) -> None:
        deadline = time.monotonic() + START_S
        while not self._is_warm:
            if connection.poll(TICK_S):
                connection.recv()
                self._is_warm = True
            elif not watch(0.0):
                raise AbandonedError("the calculation was ended before it began")
            elif time.monotonic() > deadline:
                raise ChildDiedError(f"the calculation's process was not ready after {START_S:g} s")

    def _listen(self, connection: Connection, timeout_s: float, watch: Watch) -> Outcome | Failure:
        deadline, progress = time.monotonic() + timeout_s, 0.0
        while time.monotonic() < deadline:
            message: Message | None = connection.recv() if connection.poll(TICK_S) else None
            if isinstance(message, Outcome | Failure):
                return message
            progress = progress if message is None else max(progress, message)
            if not watch(progress):
                raise AbandonedError("the calculation was ended")
        raise TimedOutError(f"the calculation took longer than {timeout_s:g} s")

    def _obituary(self) -> str:
        if self._child is None:
            return "cause unknown"
        self._child.join(1.0)
        code = self._child.exitcode
        self.kill()
        return f"exit status {code}" if code is None or code >= 0 else f"signal {-code}"

    def kill(self) -> None:
        """Kill the child; the next task gets a new one."""
        with self._starting:
            if self._child is not None:
                self._child.kill()
                self._child.join(5.0)
            if self._connection is not None:
                self._connection.close()
            self._child = self._connection = None
            self._is_warm = False
