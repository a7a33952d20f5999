"""Kernels that are not compiled yet are compiled once, in a process of their own, before a worker takes a job.

So no attempt of a job waits for the compiler, is given up for it or counts as lost. `/readyz` and the pages say how far
it has come meanwhile; jobs wait in the queue.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from typing import Final

import structlog

from magcal_core.compile_kernels import compiled_mark

COMMAND: Final = (sys.executable, "-m", "magcal_core.compile_kernels")
TICK_S: Final = 0.1

log = structlog.get_logger()


class Kernels:
    """Whether calculations may begin, and how far what they wait for has come."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._progress = (0, 0)
        self._ready = threading.Event()

    def prepare(self) -> None:
        """Have the kernels compiled, where they are not; return at once."""
        if compiled_mark().is_file():
            self._ready.set()
            return
        log.info("compiling_kernels")
        told, telling = os.pipe()
        try:
            self._process = subprocess.Popen(COMMAND, stderr=telling, start_new_session=True)  # noqa: S603  our own
        finally:
            os.close(telling)
        threading.Thread(target=self._follow, args=(self._process, told), daemon=True).start()

    def wait(self, stopping: threading.Event) -> bool:
        """Return True once calculations may begin, False where the workers are to stop before that."""
        while not self._ready.wait(TICK_S):
            if stopping.is_set():
                return False
        return True

    def stop(self) -> None:
        """Give up what is being compiled."""
        if self._process is not None and self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGTERM)
            self._process.wait()

    @property
    def preparing(self) -> tuple[int, int] | None:
        """How many parts are compiled, and of how many, 0 where that is not known yet; None once work may begin."""
        return None if self._ready.is_set() else self._progress

    def _follow(self, process: subprocess.Popen[bytes], told: int) -> None:
        last = self._listen(told)
        os.close(told)
        if process.wait() == 0:
            log.info("compiled_kernels")
        elif process.returncode > 0:
            # Each calculation compiles what it needs for itself then, as it also does where nothing can be kept.
            log.warning("kernels_not_compiled", status=process.returncode, why=last)
        self._ready.set()

    def _listen(self, told: int) -> str:
        """Follow what the compiler says of its progress, and return the last line that says something else."""
        last, line = "", b""
        while piece := os.read(told, 1024):
            *whole, line = re.split(rb"[\r\n]", line + piece)
            for said in [*whole, line]:
                text = said.decode(errors="replace").strip()
                if found := re.fullmatch(r"compiling kernels: (\d+) of (\d+)", text):
                    self._progress = int(found[1]), int(found[2])
                elif text:
                    last = text
        return last[:500]
