"""How magcal measures: candidates take turns, medians are compared, and every figure stands beside its aim."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure: what, how much, in which unit, against which aim."""

    room: str
    what: str
    value: float
    unit: str
    aim: str = ""
    is_met: bool | None = None
    note: str = ""

    def to_dict(self) -> dict[str, object]:
        """Return the figure for the JSON file."""
        return asdict(self)


def interleaved_s(
    candidates: Mapping[str, Callable[[], object]], rounds: int = 7, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return each candidate's median duration, s, over ``rounds`` in which they take turns after one warm-up each.

    ``clock``: `time.process_time` counts the processor's time of all threads in place of the time that passes.
    """
    for run in candidates.values():
        run()
    durations: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, run in candidates.items():
            gc.collect()
            start = clock()
            run()
            durations[name].append(clock() - start)
    return {name: statistics.median(values) for name, values in durations.items()}
