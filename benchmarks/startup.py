"""How long a command takes from nothing: wall time and processor time of whole processes."""

from __future__ import annotations

import os
import statistics
import subprocess
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.measure import Figure
from benchmarks.service import MAGCAL, scratch, service
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ROOM: Final = "startup"
ROUNDS: Final = 5
HELP_AIM_S: Final = 0.3
CALIBRATE_AIM_S: Final = 2.0


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    with scratch() as folder:
        telemetry, orbit = folder / "telemetry.csv", folder / "orbit.tle"
        telemetry.write_bytes(write_samples(simulated(SESSIONS[0]).samples, "csv"))
        orbit.write_text(tle_text())
        yield _cold("magcal --help", ["--help"], HELP_AIM_S)
        yield _cold(
            "magcal calibrate, 700 samples",
            ["calibrate", str(telemetry), "--tle", str(orbit), "--json"],
            CALIBRATE_AIM_S,
        )
        durations = []
        for _ in range(3):
            begun = time.perf_counter()
            with service(folder, "--workers", "0"):
                durations.append(time.perf_counter() - begun)
        yield Figure(ROOM, "magcal serve until it listens", statistics.median(durations), "s")


def _cold(what: str, arguments: Sequence[str], aim_s: float) -> Figure:
    """Return the median wall time of a command, with its processor time in the note.

    It was run once before: bytecode and compiled kernels are on the disk, as a user's interpreter leaves them.
    """
    own = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    run = partial(subprocess.run, [*MAGCAL, *arguments], capture_output=True, check=True, cwd=Path("/"), env=own)
    run()
    walls, cpus = [], []
    for _ in range(ROUNDS):
        before, begun = os.times(), time.perf_counter()
        run()
        walls.append(time.perf_counter() - begun)
        after = os.times()
        cpus.append(after.children_user + after.children_system - before.children_user - before.children_system)
    wall = statistics.median(walls)
    note = f"{statistics.median(cpus):.2f} s of processor"
    return Figure(ROOM, f"cold {what}", wall, "s", f"<= {aim_s:g}", wall <= aim_s, note)
