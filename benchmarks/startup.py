"""What a command takes from nothing: processor time of whole processes, beside that of what they cannot do without."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from app.cli.main import COMMANDS
from benchmarks.measure import Figure
from benchmarks.service import MAGCAL, scratch, service
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM: Final = "startup"
ROUNDS: Final = 5
HELP_ROUNDS: Final = 3
AIM: Final = 2.0
"""Processor time of a command over that of its bare imports, at most."""
BARE: Final = (sys.executable, "-c", "import numpy, numba, pyarrow")
BARE_HELP: Final = (sys.executable, "-c", "import click")


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder:
        telemetry, orbit = folder / "telemetry.csv", folder / "orbit.tle"
        telemetry.write_bytes(write_samples(simulated(SESSIONS[0]).samples, "csv"))
        orbit.write_text(tle_text())
        calibrate = (*MAGCAL, "calibrate", str(telemetry), "--tle", str(orbit), "--json")
        own, bare = processor_times([calibrate, BARE], ROUNDS)
        note = f"{own:.2f} s of processor, `import numpy, numba, pyarrow` {bare:.2f} s"
        yield Figure(
            ROOM,
            "cold magcal calibrate, 700 samples / bare imports",
            own / bare,
            "times",
            f"<= {AIM:g}",
            own <= AIM * bare,
            note,
        )
        yield from _help()
        durations = []
        for _ in range(3):
            begun = time.perf_counter()
            with service(folder, "--workers", "0"):
                durations.append(time.perf_counter() - begun)
        yield Figure(ROOM, "magcal serve until it listens", statistics.median(durations), "s")


def _help() -> Iterator[Figure]:
    """Yield the cost of `--help` of magcal and of each command, over that of Python with click."""
    asked = [(*MAGCAL, *words, "--help") for words in [(), *((name,) for name in COMMANDS)]]
    *own, bare = processor_times([*asked, BARE_HELP], HELP_ROUNDS)
    for name, cost in zip(["", *COMMANDS], own, strict=True):
        what = " ".join(part for part in ("magcal", name, "--help") if part)
        note = f"{1e3 * cost:.0f} ms of processor, `import click` {1e3 * bare:.0f} ms"
        yield Figure(ROOM, f"{what} / Python with click", cost / bare, "times", f"<= {AIM:g}", cost <= AIM * bare, note)


def processor_times(commands: Sequence[Sequence[str]], rounds: int) -> list[float]:
    """Return the median processor time of each command, s; they take turns.

    Each was run once before: bytecode and compiled kernels are on the disk, as a user's interpreter leaves them.
    """
    own = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    spent: list[list[float]] = [[] for _ in commands]
    for turn in range(rounds + 1):
        for command, times in zip(commands, spent, strict=True):
            before = _children_s()
            subprocess.run(command, capture_output=True, check=True, cwd=Path("/"), env=own)
            if turn:
                times.append(_children_s() - before)
    return [statistics.median(times) for times in spent]


def _children_s() -> float:
    """Return the processor time that ended children have taken, s."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime
