"""Run every benchmark: ``python -m benchmarks [ROOM ...]`` prints a table and writes it as JSON under ``results/``.

Every module of this package that has ``figures()`` takes part, each in a process of its own: one that fails is
reported, the others go on, and the exit status tells. Studies, which count errors over thousands of simulated missions
(``IS_STUDY``), run where they are named, and all of them with ``--studies``: they need time and no idle machine.
``--write-docs`` writes the latest figures into ``docs/performance-figures.md`` and measures nothing.

``MAGCAL_BENCH_ROOM_S`` is the most that one room may take (default 420 s, an hour for a study); no further room is
begun after ``MAGCAL_BENCH_MINUTES`` (default 30 min; three hours for studies).
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import pkgutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Final

import benchmarks
from benchmarks.measure import Figure
from benchmarks.record import RoomRecord, now, update_latest
from benchmarks.table import write_page

ROOM_S: Final = 420.0
STUDY_S: Final = 3600.0
MINUTES: Final = 30.0
STUDY_MINUTES: Final = 180.0
FIGURES_OF: Final = "--figures-of"
WRITE_DOCS: Final = "--write-docs"
STUDIES: Final = "--studies"
STATES: Final = {True: "met", False: "MISSED", None: ""}


def rooms() -> dict[str, bool]:
    """Return the names of the benchmark modules, and whether each is a study."""
    names = [module.name for module in pkgutil.iter_modules(benchmarks.__path__) if module.name != "__main__"]
    modules = {name: importlib.import_module(f"benchmarks.{name}") for name in names}
    return {name: hasattr(module, "IS_STUDY") for name, module in modules.items() if hasattr(module, "figures")}


def tell(room: str) -> None:
    """Print each figure of a room as a line of JSON; this is what a room's process does.

    What the room prints itself, such as the log of a server in its process, goes to the standard error.
    """
    lines = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        for figure in importlib.import_module(f"benchmarks.{room}").figures():
            print(json.dumps(figure.to_dict()), file=lines, flush=True)


def measured(room: str, most_s: float) -> Iterator[Figure]:
    """Yield the figures of a room as its process tells them, which may take ``most_s``.

    Raises
    ------
    RuntimeError
        The room failed, or took longer than it may.
    """
    command = [sys.executable, "-m", "benchmarks", FIGURES_OF, room]
    # As `magcal` runs itself; scipy, the peer that uses BLAS, is faster so as well.
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True, env=alone)
    limit = threading.Timer(most_s, os.killpg, (process.pid, signal.SIGKILL))
    limit.start()
    try:
        for line in process.stdout or ():
            yield Figure(**json.loads(line))
        status = process.wait()
    finally:
        limit.cancel()
    if status:
        raise RuntimeError("it was killed for its time" if status < 0 else f"it ended with status {status}")


def run(names: Sequence[str]) -> list[str]:
    """Measure and write the rooms in ``names``, and return what failed."""
    begun, failed, is_study = time.monotonic(), [], rooms()
    minutes = float(
        os.environ.get("MAGCAL_BENCH_MINUTES", STUDY_MINUTES if any(is_study.get(name) for name in names) else MINUTES)
    )
    for name in names:
        if time.monotonic() - begun > 60 * minutes:
            failed.append(f"{name}: not begun within {minutes:g} min")
            continue
        start, load, figures = time.monotonic(), os.getloadavg()[0], []
        most_s = float(os.environ.get("MAGCAL_BENCH_ROOM_S", STUDY_S if is_study.get(name) else ROOM_S))
        try:
            for figure in measured(name, most_s):
                figures.append(figure)
                value = f"{figure.value:12.4g} {figure.unit:10} {figure.aim:22}"
                print(f"{name:12} {figure.what:72} {value} {STATES[figure.is_met]} {figure.note}", flush=True)
        except RuntimeError as error:
            failed.append(f"{name}: {error}")
        took_s = round(time.monotonic() - start, 1)
        update_latest(RoomRecord(name, now(), took_s, round(load, 1), [figure.to_dict() for figure in figures]))
        print(f"{name:12} took {took_s:g} s", flush=True)
    return failed


def main() -> None:
    """Do what the command line says."""
    known = rooms()
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("room", nargs="*", choices=[*known, []], metavar="ROOM", help=", ".join(known))
    parser.add_argument(STUDIES, action="store_true", help="every study, where no room is named")
    parser.add_argument(WRITE_DOCS, action="store_true", help="measure nothing, write the latest figures into the docs")
    parser.add_argument(FIGURES_OF, choices=known, metavar="ROOM", help="measure one room here, print lines of JSON")
    asked = parser.parse_args()
    if asked.figures_of:
        tell(asked.figures_of)
        return
    if asked.write_docs:
        write_page()
        return
    failed = run(asked.room or [name for name, is_study in known.items() if is_study is asked.studies])
    for line in failed:
        print(f"FAILED {line}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
