"""The parent's side of a calculation: starts the child, watches it, and kills it when it must end."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from typing import Final

from app.errors import ServiceError
from app.jobs.child import Failure, Message, Outcome, Task, run

TICK_S: Final = 0.1
PRELOAD: Final = ("numpy", "scipy.linalg", "pyarrow", "numba", "app.jobs.child", "app.jobs.kinds")


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

    def start(self) -> None:
        """Start the child, if there is none, without waiting for it."""
        if self._child is not None and self._child.is_alive():
            return
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(list(PRELOAD))
        ours, theirs = context.Pipe()
        self._child = context.Process(target=run, args=(theirs, self._memory_mb, self._warm), daemon=True)
        self._child.start()
        theirs.close()
        self._connection = ours

    def wait_ready(self, timeout_s: float) -> bool:
        """Return whether the child is warm within ``timeout_s``."""
        self.start()
        if self._connection is None:
            return False
        return self._connection.poll(timeout_s)

    def run(self, task: Task, timeout_s: float, watch: Callable[[float], bool]) -> Outcome | Failure:
        """Return what ``task`` finds.

        ``watch`` is called with the progress several times a second; where it returns False, the child is killed.

        Raises
        ------
        TimedOutError, AbandonedError, ChildDiedError
            The child was killed for its time, for ``watch``, or died by itself.
        """
        self.start()
        if self._connection is None:
            raise ChildDiedError("the calculation's process could not be started")
        deadline, progress = time.monotonic() + timeout_s, 0.0
        try:
            self._connection.send(task)
            while time.monotonic() < deadline:
                message: Message | None = self._connection.recv() if self._connection.poll(TICK_S) else None
                if isinstance(message, Outcome | Failure):
                    return message
                progress = progress if message is None else max(progress, message)
                if not watch(progress):
                    raise AbandonedError("the calculation was ended")
            raise TimedOutError(f"the calculation took longer than {timeout_s:g} s")
        except (EOFError, ConnectionError, BrokenPipeError):
            raise ChildDiedError(f"the calculation's process died, {self._obituary()}") from None
        except ServiceError:
            self.kill()
            raise

    def _obituary(self) -> str:
        if self._child is None:
            return "cause unknown"
        self._child.join(1.0)
        code = self._child.exitcode
        self.kill()
        return f"exit status {code}" if code is None or code >= 0 else f"signal {-code}"

    def kill(self) -> None:
        """Kill the child; the next task gets a new one."""
        if self._child is not None:
            self._child.kill()
            self._child.join(5.0)
        if self._connection is not None:
            self._connection.close()
        self._child = self._connection = None
