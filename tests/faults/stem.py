"""A process that has imported magcal already and forks servers: a thousand kills do not import it a thousand times."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

LAUNCH = Path(__file__).with_name("launch.py")


class Stem:
    """The process that forks; it lives as long as its input is open."""

    def __init__(self) -> None:
        command = [sys.executable, str(LAUNCH), "--stem"]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def fork(self, command: Sequence[str], environment: Mapping[str, str], log: Path, out: Path) -> Forked:
        """Return a new process that runs a magcal command."""
        asked = {"command": command, "environment": dict(environment), "log": str(log), "out": str(out)}
        pid = self.ask(asked)
        assert pid is not None
        return Forked(self, command, pid)

    def ask(self, asked: Mapping[str, object]) -> int | None:
        """Return the stem's answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        answer: int | None = json.loads(self._process.stdout.readline())
        return answer

    def close(self) -> None:
        """Let the stem end."""
        self._process.communicate()


class Forked:
    """A process of a stem, to be used as a `subprocess.Popen` is."""

    def __init__(self, stem: Stem, command: Sequence[str], pid: int) -> None:
        self._stem = stem
        self.args = command
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return how it has ended, None while it runs."""
        if self.returncode is None:
            self.returncode = self._stem.ask({"ended": self.pid})
        return self.returncode

    def wait(self, timeout: float = 600.0) -> int:
        """Return how it has ended, once it has."""
        deadline = time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(list(self.args), timeout)
            time.sleep(0.02)
        return status

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Ask it to stop."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Kill it."""
        self.send_signal(signal.SIGKILL)
