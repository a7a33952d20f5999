"""Run every benchmark: ``python -m benchmarks [ROOM ...]`` prints a table and writes it as JSON under ``results/``.

Every module of this package that has ``figures()`` takes part.
"""

from __future__ import annotations

import datetime as dt
import importlib
import json
import os
import pkgutil
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

import benchmarks
from benchmarks.measure import Figure

RESULTS = Path(__file__).parent / "results"


def rooms() -> list[str]:
    """Return the names of the benchmark modules."""
    return [
        module.name
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name not in ("measure", "__main__")
    ]


def measured(names: list[str]) -> Iterator[Figure]:
    """Yield the figures of the rooms in ``names``, printing each as it comes."""
    for name in names:
        module = importlib.import_module(f"benchmarks.{name}")
        for figure in module.figures():
            state = {True: "met", False: "MISSED", None: ""}[figure.is_met]
            value = f"{figure.value:12.4g} {figure.unit:10} {figure.aim:22}"
            print(f"{figure.room:14} {figure.what:64} {value} {state} {figure.note}")
            yield figure


def main() -> None:
    """Measure, print, write."""
    figures = list(measured(sys.argv[1:] or rooms()))
    RESULTS.mkdir(exist_ok=True)
    machine = {"python": platform.python_version(), "machine": platform.machine(), "cores": os.cpu_count()}
    stamp = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    record = {"at": stamp, "machine": machine, "figures": [figure.to_dict() for figure in figures]}
    (RESULTS / "latest.json").write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
