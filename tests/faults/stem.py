"""Processes that have imported magcal already and fork servers: a thousand kills do not import it a thousand times."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

LAUNCH = Path(__file__).with_name("launch.py")


LOADED = ("LD_PRELOAD", "FAKETIME_TIMESTAMP_FILE")
"""What a process takes from its environment before it is forked."""


class Stems:
    """One stem for each library that processes are to be loaded with, and one without."""

    def __init__(self) -> None:
        self._stems: dict[tuple[str, ...], Stem] = {}
        self._numbers = itertools.count()

    def of(self, environment: Mapping[str, str]) -> Stem:
        """Return the stem of processes with such an environment."""
        key = tuple(environment.get(name, "") for name in LOADED)
        if key not in self._stems:
            self._stems[key] = Stem(environment)
        return self._stems[key]

    def run(self, *words: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
        """Return how a magcal command ended and what it wrote, which passes through files of ``folder``."""
        whole, number = os.environ | environment, next(self._numbers)
        log, out = folder / f"stderr-{number}", folder / f"stdout-{number}"
        status = self.of(whole).fork(words, whole, log, out).wait(120.0)
        return subprocess.CompletedProcess(list(words), status, out.read_text(), log.read_text())

    def close(self) -> None:
        """Let them end."""
        for one in self._stems.values():
            one.close()


class Stem:
    """The process that forks; it lives as long as its input is open."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        command = [sys.executable, str(LAUNCH), "--stem"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=dict(environment)
        )
        self._asking = threading.Lock()

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
        with self._asking:
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
